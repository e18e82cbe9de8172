"""Jobs in several processes of this machine.

Each process does one job at a time, with one thread of BLAS and numba.  One that dies takes its job
with it and nothing else: another takes its place.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from multiprocessing.connection import wait
from typing import Any

from cmp_tactile_bringup.errors import TaskError
from cmp_tactile_bringup.offline.display import Display
from cmp_tactile_bringup.offline.jobs import Outcome
from cmp_tactile_bringup.offline.remote_task import result_of, task_as_json
from cmp_tactile_bringup.offline.single_threaded_process import SingleThreadedProcess
from cmp_tactile_bringup.offline.task import Task
from cmp_tactile_bringup.offline.worker_process import work

__all__ = ["run_in_processes"]

Results = list[Outcome | Exception]


def run_in_processes(
    tasks: Sequence[Task], display: Display, processes: int, *, debug: bool
) -> Results:
    """What came of each task, or the error that ended it, in the order of the tasks."""
    crew = _Crew(tasks, display, debug=debug)
    try:
        return crew.run(min(processes, len(tasks)))
    finally:
        crew.end()


class _Worker(SingleThreadedProcess):
    """A process and the number of the task that it is at; None: idle."""

    def __init__(self) -> None:
        super().__init__(work)
        self.number: int | None = None

    def begin(self, number: int, task: Task) -> None:
        """Give it a task."""
        self.number = number
        self.send(task_as_json(task))


class _Crew:
    """The workers, and what is left to do."""

    def __init__(self, tasks: Sequence[Task], display: Display, *, debug: bool) -> None:
        self._tasks, self._display, self._debug = tasks, display, debug
        self._waiting = deque(range(len(tasks)))
        self._results: dict[int, Outcome | Exception] = {}
        self._workers: list[_Worker] = []

    def run(self, processes: int) -> Results:
        """Keep so many processes at work until all is done."""
        while len(self._results) < len(self._tasks):
            self._give_out(processes)
            busy = [worker for worker in self._workers if worker.number is not None]
            ready = wait([worker.connection for worker in busy])
            for worker in busy:
                if worker.connection in ready:
                    self._listen(worker)
        return [self._results[number] for number in range(len(self._tasks))]

    def end(self) -> None:
        """End all processes."""
        for worker in self._workers:
            worker.ask_to_end()
        for worker in self._workers:
            worker.end()

    def _give_out(self, processes: int) -> None:
        idle = [worker for worker in self._workers if worker.number is None]
        while self._waiting and (idle or len(self._workers) < processes):
            if not idle:
                idle.append(_Worker())
                self._workers.append(idle[-1])
            number = self._waiting.popleft()
            idle.pop().begin(number, self._tasks[number])

    def _listen(self, worker: _Worker) -> None:
        number = worker.number
        if number is None:
            return
        try:
            what, value = worker.connection.recv()
        except (EOFError, OSError):
            label = self._tasks[number].job.label
            self._finish(number, TaskError(f"{label}: its process {worker.why_dead()}"))
            self._workers.remove(worker)
            worker.end()
            return
        if what == "result":
            worker.number = None
            self._finish(number, result_of(value, debug=self._debug))
        else:
            show(self._display, number, what, value)

    def _finish(self, number: int, result: Outcome | Exception) -> None:
        self._results[number] = result
        self._display.end(number, result)


def show(display: Display, number: int, what: str, value: Any) -> None:
    """Show what a task in another process tells."""
    if what == "stage":
        display.stage(number, *value)
    elif what == "total":
        display.total(number, value)
    else:
        display.frames(number, value)
