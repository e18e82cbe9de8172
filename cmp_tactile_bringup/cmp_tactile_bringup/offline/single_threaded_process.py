"""A process of one thread that works for this one, told what to do over a connection."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, Pipe
from typing import Any

from cmp_tactile_processing.python_command import python_command

__all__ = ["SingleThreadedProcess", "main", "single_threaded"]

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
        # Not by multiprocessing: what that starts looks for modules in the current folder first.
        self.connection, theirs = Pipe()
        with _interrupt_held_back():
            self._process = subprocess.Popen(
                python_command(__name__, str(theirs.fileno())),
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                env={**os.environ, **single_threaded()},
            )
        theirs.close()
        self.send(sys.path)
        self.send(work)

    def send(self, what: Any) -> None:
        """Give it something; where it is dead already, that is noticed when it is listened to."""
        try:
            self.connection.send(what)
        except OSError:
            return

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


def single_threaded() -> dict[str, str]:
    """Variables by which libraries keep to one thread, for a process that begins."""
    return dict.fromkeys(SINGLE_THREADED, "1")


@contextmanager
def _interrupt_held_back() -> Iterator[None]:
    """Ctrl-C is held back meanwhile, here and for good in the process that begins."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def main() -> None:
    """Do the work on the connection that has the given file descriptor."""
    connection: Connection[Any, Any] = Connection(int(sys.argv[1]))
    with suppress(EOFError):
        # Modules are found where the process that began this one finds them.
        sys.path[:] = filter(None, connection.recv())
        connection.recv()(connection)


if __name__ == "__main__":
    main()
