"""Tasks one after another in this process, or several at once in processes of this machine.

Each process does one task at a time, with one thread of BLAS and numba.  One that dies takes its
task with it and nothing else: another takes its place.  A pool of joblib or concurrent.futures
gives up all tasks when one process dies, and joblib's processes import modules of the current
folder.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from functools import partial
from multiprocessing.connection import Connection, Pipe, wait
from typing import Any

from rich import progress
from rich.console import Console
from rich.markup import escape

from cmp_tactile_bringup.errors import TaskError
from cmp_tactile_bringup.offline.jobs import Outcome
from cmp_tactile_bringup.offline.processor import Report, Task, result_of, run_remotely, run_task
from cmp_tactile_processing.errors import printable
from cmp_tactile_processing.python_command import python_command

Ended = Callable[[int, Outcome | Exception], None]


class Display(progress.Progress):
    """A bar for each recording that is at work and one for all; a context manager.

    Recordings go by their number.  May be called from several threads.
    """

    def __init__(self, names: Sequence[str], console: Console, ended: Ended) -> None:
        """ended: called with what came of each recording as soon as it has ended."""
        columns = (
            progress.TextColumn("{task.description}"),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
        )
        super().__init__(
            *columns, progress.TimeElapsedColumn(), progress.TimeRemainingColumn(), console=console
        )
        self._ended = ended
        self._names = [escape(printable(name)) for name in names]
        self._bars: dict[int, progress.TaskID] = {}
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

    def _bar(self, number: int) -> progress.TaskID:
        if number not in self._bars:
            self._bars[number] = self.add_task(self._names[number], total=None)
        return self._bars[number]


SINGLE_THREADED = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)
SECONDS_TO_END = 10.0


def run_here(tasks: Sequence[Task], display: Display, *, debug: bool) -> None:
    """Run the tasks in this process.  debug: print tracebacks."""
    for number, task in enumerate(tasks):
        display.end(number, _result_here(task, partial(display.show, number), debug=debug))


def _result_here(task: Task, report: Report, *, debug: bool) -> Outcome | Exception:
    try:
        return run_task(task, report)
    except Exception as error:  # noqa: BLE001  the others are to be processed all the same
        if debug:
            traceback.print_exc()
        return error


def run_in_processes(
    tasks: Sequence[Task], display: Display, processes: int, *, debug: bool
) -> None:
    """Run the tasks in so many processes."""
    ahead = deque(enumerate(tasks))
    workers: list[_Worker] = []
    try:
        while ahead or any(worker.number is not None for worker in workers):
            _give_out(ahead, workers, processes)
            busy = [worker for worker in workers if worker.number is not None]
            ready = wait([worker.connection for worker in busy])
            for worker in busy:
                if worker.connection in ready and not _listen(worker, display, debug=debug):
                    workers.remove(worker)
                    worker.end()
    finally:
        for worker in workers:
            worker.ask_to_end()
        for worker in workers:
            worker.end()


def _give_out(ahead: deque[tuple[int, Task]], workers: list[_Worker], processes: int) -> None:
    idle = [worker for worker in workers if worker.number is None]
    while ahead and (idle or len(workers) < processes):
        if not idle:
            idle.append(_Worker())
            workers.append(idle[-1])
        idle.pop().begin(*ahead.popleft())


def _listen(worker: _Worker, display: Display, *, debug: bool) -> bool:
    """Receive one report of a busy worker; whether it is alive."""
    number = worker.number
    if number is None:
        return True
    try:
        event, value = worker.connection.recv()
    except (EOFError, OSError):
        display.end(number, TaskError(f"{worker.label}: its process {worker.why_dead()}"))
        return False
    if event == "result":
        worker.number = None
        display.end(number, result_of(value, debug=debug))
    else:
        display.show(number, event, value)
    return True


class _Worker:
    """A process with one thread of BLAS and numba, and the number of its task; None: idle."""

    def __init__(self) -> None:
        self.number: int | None = None
        self.label = ""
        # Not by multiprocessing: what that starts looks for modules in the current folder first.
        self.connection, theirs = Pipe()
        with _interrupt_held_back():
            self._process = subprocess.Popen(
                python_command(__name__, str(theirs.fileno())),
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                env={**os.environ, **dict.fromkeys(SINGLE_THREADED, "1")},
            )
        theirs.close()

    def begin(self, number: int, task: Task) -> None:
        """Give it a task; where it is dead already, that is noticed when it is listened to."""
        self.number, self.label = number, task.job.label
        with suppress(OSError):
            self.connection.send(asdict(task))

    def why_dead(self) -> str:
        """How the process ended."""
        try:
            code = self._process.wait(SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            return "does not answer"
        if code < 0:
            name = signal.Signals(-code).name
            memory = "; was there enough memory?" if -code == signal.SIGKILL else ""
            return f"was ended by {name}{memory}"
        return f"ended with code {code}"

    def ask_to_end(self) -> None:
        """Have it remove what it has not finished, and end; `end` waits for it."""
        self._process.terminate()

    def end(self) -> None:
        """End the process, politely first."""
        self._process.terminate()
        try:
            self._process.wait(SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self.connection.close()


@contextmanager
def _interrupt_held_back() -> Iterator[None]:
    """Ctrl-C is held back meanwhile, here and for good in the process that begins."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def main() -> None:
    """Receive tasks on the connection with the given file descriptor, send reports and results.

    Ends when the other side does, also in the middle of a task.
    """
    # Ctrl-C reaches all processes of a terminal; the one that began ends these by SIGTERM.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)

    import cv2

    cv2.setNumThreads(1)
    connection: Connection[Any, Any] = Connection(int(sys.argv[1]))
    parent = os.getppid()

    def report(event: str, value: object) -> None:
        if os.getppid() != parent:
            sys.exit(1)  # killed; nobody waits for these results
        connection.send((event, value))

    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            report("result", run_remotely(connection.recv(), report))


def _leave(*_: object) -> None:
    """Remove what is not finished, and do so undisturbed."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit(128 + signal.SIGTERM)


if __name__ == "__main__":
    main()
