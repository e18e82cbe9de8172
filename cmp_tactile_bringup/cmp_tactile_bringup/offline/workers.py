"""Tasks one after another in this process, or several at once in processes of this machine.

The processes are a pool of concurrent.futures with one thread of BLAS and numba each.  joblib's
pool gives neither progress nor which of its tasks had begun when a process died.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from multiprocessing import active_children, get_context, parent_process
from typing import TYPE_CHECKING, Any

from cmp_tactile_bringup.errors import TaskError
from cmp_tactile_bringup.offline.jobs import Outcome, Task
from cmp_tactile_bringup.offline.processor import run_guarded

if TYPE_CHECKING:
    from multiprocessing.queues import SimpleQueue

    from cmp_tactile_bringup.offline.display import Display

ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
}
# Python looks for its first modules in the folder that a process begins in; beside a recording,
# anybody's may lie.  multiprocessing then has the process go on in its parent's folder.
FOLDER_WITHOUT_MODULES = "/"
SECONDS_BETWEEN_REPORTS = 0.1


def run_here(tasks: Sequence[Task], display: Display) -> None:
    """Run the tasks in this process."""
    for number, task in enumerate(tasks):
        display.end(number, run_guarded(task, partial(display.show, number)))


def run_in_processes(tasks: Sequence[Task], display: Display, processes: int) -> None:
    """Run the tasks in so many processes.

    Where one dies, its pool ends the others, too: what they had begun is done again, each task by
    itself, so that only one whose process dies again is lost.
    """
    left = dict(enumerate(tasks))
    while left:
        begun = _run_pool(left, display, processes)
        for number in begun:
            alone = {number: left.pop(number)}
            if _run_pool(alone, display, 1):
                text = "its process ended early, twice; was there enough memory?"
                display.end(number, TaskError(f"{alone[number].job.label}: {text}"))


def _run_pool(left: dict[int, Task], display: Display, processes: int) -> list[int]:
    """Run tasks, and take those that end out of `left`.

    Returns what had begun when a process died, at least one task; nothing where none did.
    """
    begun: set[int] = set()
    with _for_new_processes():
        context = get_context("spawn")
        reports: SimpleQueue[tuple[int, str, Any]] = context.SimpleQueue()
        workers = min(processes, len(left))
        pool = ProcessPoolExecutor(workers, context, _begin_process, (reports,))
        futures = {pool.submit(_run_task, number, task): number for number, task in left.items()}
    with pool:
        try:
            ends: set[Future[Outcome | TaskError]] = set()
            while len(ends) < len(futures):
                new, _ = wait(futures.keys() - ends, SECONDS_BETWEEN_REPORTS, FIRST_COMPLETED)
                while not reports.empty():
                    number, event, value = reports.get()
                    begun.add(number)
                    display.show(number, event, value)
                ends |= new
                for future in new:
                    if not isinstance(future.exception(), BrokenProcessPool):
                        display.end(futures[future], future.result())
                        del left[futures[future]]
        except BaseException:
            for future in futures:
                future.cancel()
            for child in active_children():
                child.terminate()
            raise
    return sorted(begun & left.keys()) or list(left)[:1]


@contextmanager
def _for_new_processes() -> Iterator[None]:
    """Processes that begin here have ENVIRONMENT and run nothing of the current folder.

    They never receive Ctrl-C or the end of the terminal: their parent ends them.
    """
    before, folder = dict(os.environ), os.open(".", os.O_PATH)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGHUP])
    os.environ.update(ENVIRONMENT)
    os.chdir(FOLDER_WITHOUT_MODULES)
    try:
        yield
    finally:
        os.chdir(folder)
        os.close(folder)
        for name in ENVIRONMENT:
            del os.environ[name]
        os.environ.update(before)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


_reports: SimpleQueue[tuple[int, str, Any]]


def _begin_process(reports: SimpleQueue[tuple[int, str, Any]]) -> None:
    """In a new process.  SIGTERM, or the end of its parent, has it remove what is not finished."""
    import cv2

    global _reports  # noqa: PLW0603  a queue is given to a process as it begins, and only then
    _reports = reports
    cv2.setNumThreads(1)
    signal.signal(signal.SIGTERM, lambda number, _frame: sys.exit(128 + number))
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
    os.kill(os.getpid(), signal.SIGTERM)


def _run_task(number: int, task: Task) -> Outcome | TaskError:
    try:
        return run_guarded(task, lambda event, value: _reports.put((number, event, value)))
    except SystemExit:
        os._exit(1)  # the pool would go on with the next task
