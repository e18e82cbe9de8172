"""A process of one thread that works for this one, told what to do over a connection."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

__all__ = ["SingleThreadedProcess", "single_threaded"]

SINGLE_THREADED = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)
SECONDS_TO_END = 10.0


class SingleThreadedProcess:
    """Begins anew, with one thread of BLAS and numba.

    work: function of a module, called there with the other end of `connection`.
    """

    def __init__(self, work: Callable[[Connection], None]) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=work, args=(theirs,), daemon=True)
        with _environment_of_workers():
            self._process.start()
        theirs.close()

    def send(self, what: Any) -> None:
        """Give it something; where it is dead already, that is noticed when it is listened to."""
        try:
            self.connection.send(what)
        except OSError:
            return

    def why_dead(self) -> str:
        """How the process ended."""
        self._process.join(SECONDS_TO_END)
        code = self._process.exitcode
        if code is None:
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
        self._process.join(SECONDS_TO_END)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self.connection.close()


def single_threaded() -> dict[str, str]:
    """Variables by which libraries keep to one thread, for a process that begins."""
    return dict.fromkeys(SINGLE_THREADED, "1")


@contextmanager
def _environment_of_workers() -> Iterator[None]:
    """Libraries read the number of their threads when they are loaded.

    Ctrl-C is held back meanwhile, here and for good in the process that begins.
    """
    earlier = {name: os.environ.get(name) for name in SINGLE_THREADED}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    os.environ.update(single_threaded())
    try:
        yield
    finally:
        for name, value in earlier.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
