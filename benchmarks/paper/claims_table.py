"""The claims on the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.markup import escape
from rich.table import Table

from paper.experiment import Claim
from paper.page import MET_WORDS

__all__ = ["claims_table"]

STYLES = {True: "green", False: "bold red", None: "dim"}


def claims_table(claims: Sequence[Claim]) -> Table:
    """Section, claim, the paper's figure, ours, met or not."""
    table = Table(
        title="Claims of the paper (none of them decides how the run ends)",
        title_justify="left",
        title_style="bold",
    )
    for heading in ("Section", "Claim", "The paper", "Here", "Met"):
        table.add_column(heading, overflow="fold")
    for claim in claims:
        texts = (claim.section, claim.what, claim.paper, claim.ours)
        style = STYLES[claim.met]
        told = [escape(text.replace("`", "")) for text in texts]
        table.add_row(*told, f"[{style}]{MET_WORDS[claim.met]}[/]")
    return table
