"""Tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.table import Table
from rich.text import Text

from cmp_tactile_bringup.report.evaluation import TableRow
from cmp_tactile_processing.errors import printable

__all__ = ["cell", "facts_table", "results_table"]


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
