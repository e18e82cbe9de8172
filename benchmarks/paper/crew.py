"""Tasks in several processes of one thread each; one that dies takes its task and nothing else."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import Any, Protocol

from cmp_tactile_bringup.offline.single_threaded_process import SingleThreadedProcess
from paper.worker import Answer, work

__all__ = ["Crew", "Listener", "Outcome", "Task"]

SECONDS_BETWEEN_TICKS = 0.5


@dataclass(frozen=True)
class Task:
    """Something to do in another process.

    name: what users read.  run: can be pickled; is told whether to wait for what another task is
    at, or to raise Busy.  seconds: it takes, roughly.  alone: while nothing else runs.
    """

    name: str
    run: Callable[[bool], Any]
    seconds: float = 1.0
    alone: bool = False


@dataclass(frozen=True)
class Outcome:
    """What came of a task; error is empty where it went well."""

    task: Task
    value: Any
    error: str
    trace: str
    wall: float
    processor: float


class Listener(Protocol):
    """Is told what goes on."""

    def begun(self, task: Task) -> None:
        """A process is at it from now on."""

    def put_back(self, task: Task) -> None:
        """It is to be begun again later."""

    def ended(self, outcome: Outcome) -> None:
        """A process is through with it."""

    def tick(self) -> None:
        """Time has passed."""


class _Worker(SingleThreadedProcess):
    """A process and the task that it is at; None: idle."""

    def __init__(self) -> None:
        super().__init__(work)
        self.task: Task | None = None
        self.since = 0.0

    def begin(self, task: Task, *, patient: bool) -> None:
        """Give it a task."""
        self.task = task
        self.since = time.perf_counter()
        self.send((task.run, patient))

    def answer(self) -> Answer | None:
        """What it found; None where it is dead."""
        try:
            answer: Answer = self.connection.recv()
        except (EOFError, OSError):
            return None
        return answer


class Crew:
    """Processes that do tasks, the longest first; a context manager, which ends them.

    processes: at most so many at a time.
    """

    def __init__(self, processes: int, listener: Listener) -> None:
        self._processes = processes
        self._listener = listener
        self._waiting: list[Task] = []
        # They wait for what another is at, and are tried again when that may have ended.
        self._put_back: list[Task] = []
        self._workers: list[_Worker] = []

    def __enter__(self) -> Crew:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.ask_to_end()
        for worker in self._workers:
            worker.end()

    def add(self, tasks: Iterable[Task]) -> None:
        """Do these, too."""
        self._waiting += tasks

    def outcomes(self) -> Iterator[Outcome]:
        """What came of the tasks as they end, also of those that are added meanwhile."""
        while True:
            self._give_out()
            busy = [worker for worker in self._workers if worker.task is not None]
            if not busy:
                return
            ready = wait([worker.connection for worker in busy], SECONDS_BETWEEN_TICKS)
            for worker in busy:
                if worker.connection in ready and (outcome := self._listen(worker)):
                    self._waiting += self._put_back
                    self._put_back = []
                    self._listener.ended(outcome)
                    yield outcome
            self._listener.tick()

    def _give_out(self) -> None:
        while (found := self._next()) is not None:
            task, patient = found
            idle = [worker for worker in self._workers if worker.task is None]
            if not idle:
                idle.append(_Worker())
                self._workers.append(idle[0])
            self._listener.begun(task)
            idle[0].begin(task, patient=patient)

    def _next(self) -> tuple[Task, bool] | None:
        """The task to begin now, and whether it may wait for others; None: not now."""
        busy = [worker.task for worker in self._workers if worker.task is not None]
        if len(busy) >= self._processes or any(task.alone for task in busy):
            return None
        if together := [task for task in self._waiting if not task.alone]:
            # Two that begin together may overtake each other: then, too, there is other work.
            patient = not busy and len(self._waiting) == 1
            return self._take(self._waiting, together), patient
        if self._put_back:
            # Nothing else can be done until what they wait for is there.
            return self._take(self._put_back, self._put_back), True
        if self._waiting and not busy:
            return self._take(self._waiting, self._waiting), True
        return None

    @staticmethod
    def _take(from_which: list[Task], among: list[Task]) -> Task:
        task = max(among, key=lambda task: task.seconds)
        from_which.remove(task)
        return task

    def _listen(self, worker: _Worker) -> Outcome | None:
        task, answer = worker.task, worker.answer()
        if task is None:
            return None
        if answer is None:
            took = time.perf_counter() - worker.since
            error = f"its process {worker.why_dead()}"
            self._workers.remove(worker)
            worker.end()
            return Outcome(task, None, error, "", took, 0.0)
        worker.task = None
        if answer.busy:
            self._put_back.append(task)
            self._listener.put_back(task)
            return None
        took, used = answer.wall, answer.processor
        return Outcome(task, answer.value, answer.error, answer.trace, took, used)
