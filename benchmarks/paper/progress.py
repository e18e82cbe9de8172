"""How far the run is: bars on a terminal, a line for each task that ended elsewhere."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from paper.crew import Outcome, Task

__all__ = ["Display", "duration"]

# Of its declared time, a task that runs counts as done at most so much.
ALMOST = 0.95
# Of all, from where the time that ended tasks took tells more than what was declared.
ENOUGH = 0.1


class Display:
    """Told by the crew what goes on; a context manager.

    seconds: of all tasks, as declared, with those that are added later.
    """

    def __init__(self, console: Console, seconds: float, count: int, processes: int) -> None:
        self._console = console
        self._seconds, self._count, self._processes = seconds, count, processes
        self._declared = self._took = 0.0
        self._ended = 0
        self._running: dict[str, tuple[Task, float]] = {}
        self._rows: dict[str, TaskID] = {}
        columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
        self._progress = Progress(*columns, TextColumn("{task.fields[left]}"), console=console)
        self._all = self._progress.add_task("all", total=max(seconds, 1e-9), left="")

    def __enter__(self) -> Display:
        if self._console.is_terminal:
            self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for name in list(self._rows):
            self._progress.remove_task(self._rows.pop(name))
        self._progress.stop()

    def begun(self, task: Task) -> None:
        """A process is at it from now on."""
        self._running[task.name] = (task, time.monotonic())
        name = escape(f"  {task.name}")
        self._rows[task.name] = self._progress.add_task(name, total=task.seconds, left="")

    def put_back(self, task: Task) -> None:
        """It is to be begun again later."""
        self._forget(task)

    def ended(self, outcome: Outcome) -> None:
        """A process is through with it."""
        self._forget(outcome.task)
        self._declared += outcome.task.seconds
        # An error may come early, and tells nothing of how long the others take.
        self._took += outcome.task.seconds if outcome.error else outcome.wall
        self._ended += 1
        what = f"FAILED, {outcome.error}" if outcome.error else duration(outcome.wall)
        line = f"{self._ended:3d} of {self._count}  {outcome.task.name}: {what}"
        if not self._console.is_terminal:
            line += f"  ({self.left()})"
        elif not outcome.error:
            return
        self._console.print(escape(line), highlight=False, soft_wrap=True)

    def tick(self) -> None:
        """Time has passed."""
        done = self._declared
        for name, (task, since) in self._running.items():
            part = min(time.monotonic() - since, ALMOST * task.seconds)
            done += part
            self._progress.update(self._rows[name], completed=part)
        told = f"{self._ended} of {self._count}, {self.left()}"
        self._progress.update(self._all, completed=done, left=told)

    def left(self) -> str:
        """About how long it takes from now on."""
        now = time.monotonic()
        running = [max(t.seconds - (now - since), 0.0) for t, since in self._running.values()]
        declared = sum(task.seconds for task, _ in self._running.values())
        waiting = max(self._seconds - self._declared - declared, 0.0)
        known = self._declared > ENOUGH * self._seconds
        pace = self._took / self._declared if known else 1.0
        seconds = pace * (waiting + sum(running)) / self._processes
        return f"about {duration(max(seconds, *running, 1.0))} left"

    def _forget(self, task: Task) -> None:
        del self._running[task.name]
        self._progress.remove_task(self._rows.pop(task.name))


def duration(seconds: float) -> str:
    """Seconds as one says them."""
    if seconds < 100.0:
        return f"{seconds:.3g} s" if seconds < 10.0 else f"{seconds:.0f} s"
    if seconds < 100 * 60.0:
        return f"{seconds / 60.0:.1f} min"
    return f"{seconds / 3600.0:.1f} h"
