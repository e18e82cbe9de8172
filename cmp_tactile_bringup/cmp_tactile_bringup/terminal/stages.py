"""Progress of work in several stages, on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from cmp_tactile_bringup.terminal.tables import output_console

__all__ = ["CountingBar", "Teller", "shown_count", "shown_stages", "stage_teller"]

Teller = Callable[[str, float], None]
"""Takes what is done, and its share from 0 to 1."""


class CountingBar:
    """One bar for work of several parts that counts through all of them.

    Called with what is being done, which stands beside the bar, how much is done, and of how much.
    """

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._task = progress.add_task("beginning", total=None)

    def __call__(self, what: str, done: int, total: int) -> None:
        """Show it."""
        self._progress.update(self._task, description=what, completed=done, total=max(total, 1))


def stage_teller(progress: Progress, **fields: Any) -> Teller:
    """A bar for each thing that is done, in the order in which it is first told.

    fields: that the columns of the progress need.
    """
    tasks: dict[str, Any] = {}

    def tell(what: str, share: float) -> None:
        if what not in tasks:
            tasks[what] = progress.add_task(what, total=100, **fields)
        progress.update(tasks[what], completed=round(100 * share))

    return tell


@contextmanager
def shown_stages() -> Iterator[Teller]:
    """Bars on stderr with the time that each stage took; nothing where nothing is told."""
    with _bars() as progress:
        yield stage_teller(progress)


@contextmanager
def shown_count() -> Iterator[CountingBar]:
    """One bar on stderr for work that counts."""
    with _bars() as progress:
        yield CountingBar(progress)


def _bars() -> Progress:
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn())
    return Progress(*columns, TimeElapsedColumn(), console=output_console(stderr=True))
