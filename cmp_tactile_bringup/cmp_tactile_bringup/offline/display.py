"""Bars for recordings at work."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rich import progress
from rich.console import Console
from rich.markup import escape

from cmp_tactile_bringup.offline.jobs import Outcome
from cmp_tactile_processing.errors import printable


class Display(progress.Progress):
    """A bar for each recording that is at work and one for all; a context manager.

    Recordings go by their number.  May be called from several threads.
    """

    def __init__(
        self,
        names: Sequence[str],
        console: Console,
        ended: Callable[[int, Outcome | Exception], None],
    ) -> None:
        """ended: called with the result of each recording as soon as it has ended."""
        columns = (
            progress.TextColumn("{task.description}"),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TimeElapsedColumn(),
            progress.TimeRemainingColumn(),
        )
        super().__init__(*columns, console=console)
        self._ended = ended
        self._names = [escape(printable(name)) for name in names]
        self._bars: dict[int, progress.TaskID] = {}
        self._all = self.add_task("all recordings", total=len(names), visible=len(names) > 1)

    def show(self, number: int, event: str, value: Any) -> None:
        """Show what a task reports (`processor.Report`)."""
        name = self._names[number]
        if number not in self._bars:
            self._bars[number] = self.add_task(name, total=None)
        bar = self._bars[number]
        if event == "stage":
            what, share = value
            text = f"{name}: {escape(printable(what))}"
            self.update(bar, description=text, total=100, completed=round(100 * share))
        elif event == "total":
            self.reset(bar, total=value, description=name)
        else:
            self.update(bar, completed=value)

    def end(self, number: int, result: Outcome | Exception) -> None:
        """The recording is finished, or cannot be used."""
        self._ended(number, result)
        self.advance(self._all)
        if number in self._bars and len(self._names) > 1:
            self.remove_task(self._bars.pop(number))
