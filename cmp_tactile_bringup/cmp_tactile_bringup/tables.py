"""Tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.table import Table

from cmp_tactile_bringup.report.evaluation import TableRow

__all__ = ["facts_table", "results_table"]


def facts_table(title: str, facts: Mapping[str, str]) -> Table:
    """Two columns: what, and what it is."""
    table = Table(title=title, title_justify="left", title_style="bold", show_header=False)
    table.add_column(style="cyan", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in facts.items():
        table.add_row(name, value)
    return table


def results_table(title: str, rows: Sequence[TableRow]) -> Table:
    """Measured values with their limits."""
    table = Table(title=title, title_justify="left", title_style="bold")
    for heading in ("Quantity", "Measured", "Limit", ""):
        table.add_column(heading)
    marks = {None: "", True: "[green]kept[/]", False: "[bold red]missed[/]"}
    for row in rows:
        table.add_row(row.name, row.value, row.limit, marks[row.passed])
    return table
