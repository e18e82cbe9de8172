"""What is printed: consoles for terminals, pipes and files, and tables."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table
from rich.text import Text

from cmp_tactile_processing.errors import printable

if TYPE_CHECKING:
    from cmp_tactile_bringup.report.evaluation import TableRow

__all__ = ["cell", "facts_table", "output_console", "results_table"]

# No line of ours is longer.
UNBOUNDED = 10_000


class _PlainConsole(Console):
    """Draws tables and bars of characters that every terminal has."""

    @property
    def encoding(self) -> str:
        """What rich takes its frames and bars for."""
        return "ascii"


def output_console(*, stderr: bool = False) -> Console:
    """The console of a standard stream: lines as wide as the terminal, or COLUMNS.

    Whole lines in a pipe or file, where words and paths are to be found and copied.  Plain
    characters where TERM is dumb.
    """
    made = (_PlainConsole if os.environ.get("TERM") == "dumb" else Console)(stderr=stderr)
    if not made.is_terminal and "COLUMNS" not in os.environ:
        made.width = UNBOUNDED
    return made


def facts_table(title: str, facts: Mapping[str, str]) -> Table:
    """Two columns: what, and what it is."""
    table = Table(title=cell(title), title_justify="left", title_style="bold", show_header=False)
    table.add_column(style="cyan", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in facts.items():
        table.add_row(cell(name), cell(value))
    return table


def results_table(title: str, rows: Sequence[TableRow]) -> Table:
    """Measured values with their limits."""
    table = Table(title=cell(title), title_justify="left", title_style="bold")
    for heading in ("Quantity", "Measured", "Limit", ""):
        table.add_column(heading)
    marks = {None: "", True: "[green]kept[/]", False: "[bold red]missed[/]"}
    for row in rows:
        table.add_row(cell(row.name), cell(row.value), cell(row.limit), marks[row.passed])
    return table


def cell(text: str) -> Text:
    """A text as it is: names may hold brackets, which are no markup, and escape sequences."""
    return Text(printable(text))
