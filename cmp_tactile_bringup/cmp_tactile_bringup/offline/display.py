"""Progress of many recordings on a terminal: those at work, and all together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from cmp_tactile_bringup.offline.jobs import Outcome
from cmp_tactile_processing.errors import printable

__all__ = ["Display"]

Ended = Callable[[int, Outcome | Exception], None]


class Display(Progress):
    """A bar for each recording that is at work and one for all; a context manager.

    Recordings go by their number.  May be called from several threads.
    """

    def __init__(self, names: Sequence[str], console: Console, ended: Ended) -> None:
        """ended: called with what came of each recording as soon as it has ended."""
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        super().__init__(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console)
        self._ended = ended
        self._names = [escape(printable(name)) for name in names]
        self._bars: dict[int, TaskID] = {}
        self._all = self.add_task("all recordings", total=len(names), visible=len(names) > 1)

    def show(self, number: int, event: str, value: Any) -> None:
        """What a task reports (`task.Report`)."""
        if event == "stage":
            self.stage(number, *value)
        elif event == "total":
            self.total(number, value)
        else:
            self.frames(number, value)

    def stage(self, number: int, what: str, share: float) -> None:
        """What is done before the first frame."""
        text = f"{self._names[number]}: {escape(printable(what))}"
        done = round(100 * share)
        self.update(self._bar(number), description=text, total=100, completed=done)

    def total(self, number: int, frames: int | None) -> None:
        """The first frame comes next, of so many."""
        bar = self._bar(number)
        self.reset(bar, total=frames, description=self._names[number])

    def frames(self, number: int, count: int) -> None:
        """So many frames were processed."""
        self.advance(self._bar(number), count)

    def end(self, number: int, result: Outcome | Exception) -> None:
        """The recording is finished, or cannot be used."""
        self._ended(number, result)
        self.advance(self._all)
        if number in self._bars and len(self._names) > 1:
            self.remove_task(self._bars.pop(number))

    def _bar(self, number: int) -> TaskID:
        if number not in self._bars:
            self._bars[number] = self.add_task(self._names[number], total=None)
        return self._bars[number]
