"""Tasks in several processes of one thread each; one that dies fails its task and nothing else."""

from __future__ import annotations

import re
import signal
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from typing import Any

from joblib.externals.loky import get_reusable_executor
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

SECONDS_BETWEEN_TICKS = 0.5
# An idle process ends after so long, s: also where the one that began it was killed.
IDLE = 100
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
# Of its declared time, a task that runs counts as done at most so much.
ALMOST = 0.95
# How far back the pace counts by which the time that is left is estimated, s.
PACE_OF = 600.0


@dataclass(frozen=True)
class Task:
    """Something to do in another process.

    name: what users read.  run: can be pickled.  seconds: it takes, roughly.  alone: while nothing
    else runs.
    """

    name: str
    run: Callable[[], Any]
    seconds: float = 1.0
    alone: bool = False


@dataclass(frozen=True)
class Outcome:
    """What came of a task; error is empty where it went well.  wall: time on the clock, s."""

    task: Task
    value: Any = None
    error: str = ""
    trace: str = ""
    wall: float = 0.0


def executor(processes: int) -> Any:
    """Processes with one thread of BLAS, OpenCV and numba, which ignore Ctrl-C."""
    environment = dict.fromkeys(THREADS, "1") | {"PYTHONSAFEPATH": "1"}
    return get_reusable_executor(processes, timeout=IDLE, initializer=_begin, env=environment)


def _begin() -> None:
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)


def outcomes(tasks: list[Task], processes: int, display: Display) -> Iterator[Outcome]:
    """Do all tasks, the longest first, and give what came of each as it ends.

    Tasks may be added to the list meanwhile.
    """
    running: dict[Future[Outcome], Task] = {}
    try:
        while tasks or running:
            while (task := _next(tasks, list(running.values()), processes)) is not None:
                display.begun(task)
                running[executor(processes).submit(_done, task)] = task
            for future in wait(running, SECONDS_BETWEEN_TICKS, FIRST_COMPLETED).done:
                task = running.pop(future)
                outcome = _outcome(future, task)
                if outcome is None and processes > 1 and not task.alone:
                    # This task or one beside it ended the process: alone it will be seen.
                    display.put_back(task)
                    tasks.append(replace(task, alone=True))
                    continue
                outcome = outcome or Outcome(task, error=_why_dead(future))
                display.ended(outcome)
                yield outcome
            display.tick()
    finally:
        executor(processes).shutdown(kill_workers=True)


def _next(tasks: list[Task], running: list[Task], processes: int) -> Task | None:
    """The task to begin now; None: not now."""
    if len(running) >= processes or any(task.alone for task in running):
        return None
    free = [task for task in tasks if not task.alone] or ([] if running else tasks)
    task = max(free, key=lambda task: task.seconds, default=None)
    if task is not None:
        tasks.remove(task)
    return task


def _done(task: Task) -> Outcome:
    began = time.perf_counter()
    try:
        value, error, trace = task.run(), "", ""
    except Exception as found:  # noqa: BLE001  the other tasks go on
        value, error, trace = None, f"{type(found).__name__}: {found}", traceback.format_exc()
    return Outcome(task, value, error, trace, time.perf_counter() - began)


def _outcome(future: Future[Outcome], task: Task) -> Outcome | None:
    """None where the process died."""
    try:
        return replace(future.result(), task=task)
    except BrokenProcessPool:
        return None


def _why_dead(future: Future[Outcome]) -> str:
    name = re.search(r"SIG[A-Z]+", str(future.exception()))
    if name is None:
        return "its process ended"
    memory = "; was there enough memory?" if name.group() == "SIGKILL" else ""
    return f"its process was ended by {name.group()}{memory}"


class Display:
    """How far the run is: bars on a terminal, a line for each task that ended elsewhere.

    seconds: of all tasks, as declared, with those that are added later.
    """

    def __init__(self, console: Console, seconds: float, count: int) -> None:
        self._console = console
        self._count, self._ended, self._declared = count, 0, 0.0
        self._running: dict[str, tuple[Task, float, TaskID]] = {}
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console,
            speed_estimate_period=PACE_OF,
        )
        self._all = self._progress.add_task("all", total=max(seconds, 1e-9))

    def __enter__(self) -> Display:
        if self._console.is_terminal:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        for _task, _since, row in self._running.values():
            self._progress.remove_task(row)
        self._progress.stop()

    def begun(self, task: Task) -> None:
        """A process is at it from now on."""
        row = self._progress.add_task(escape(f"  {task.name}"), total=task.seconds)
        self._running[task.name] = task, time.monotonic(), row

    def put_back(self, task: Task) -> None:
        """It is to be begun again later."""
        self._progress.remove_task(self._running.pop(task.name)[2])

    def ended(self, outcome: Outcome) -> None:
        """A process is through with it."""
        self.put_back(outcome.task)
        self._declared += outcome.task.seconds
        self._ended += 1
        self.tick()
        what = f"FAILED, {outcome.error}" if outcome.error else duration(outcome.wall)
        line = f"{self._ended:3d} of {self._count}  {outcome.task.name}: {what}"
        if not self._console.is_terminal:
            left = self._progress.tasks[self._all].time_remaining
            line += f"  (about {duration(left)} left)" if left else ""
        elif not outcome.error:
            return
        self._console.print(escape(line), highlight=False, soft_wrap=True)

    def tick(self) -> None:
        """Time has passed."""
        done, now = self._declared, time.monotonic()
        for task, since, row in list(self._running.values()):
            part = min(now - since, ALMOST * task.seconds)
            done += part
            self._progress.update(row, completed=part)
        count = f"{self._ended} of {self._count}"
        self._progress.update(self._all, completed=done, description=count)


def duration(seconds: float) -> str:
    """Seconds as one says them."""
    if seconds < 100.0:
        return f"{seconds:.3g} s" if seconds < 10.0 else f"{seconds:.0f} s"
    if seconds < 100 * 60.0:
        return f"{seconds / 60.0:.1f} min"
    return f"{seconds / 3600.0:.1f} h"
