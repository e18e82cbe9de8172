"""How processes of this software are started, what they say of their progress, how they end."""

from __future__ import annotations

import atexit
import math
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from types import FrameType
from typing import Any

OnProgress = Callable[[str, float], None]
"""Takes what is being done, and the share of it that is done, from 0 to 1."""

# For Python 3.10, which has no option -P.  Only sys, which is built in, is imported before the
# current folder is taken off the path.  Python 3.13 imports more before it runs such a line.
RUN_MODULE = (
    "import sys; sys.path[:] = filter(None, sys.path); import runpy; "
    "runpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)"
)
NUMBERS = (signal.SIGINT, signal.SIGHUP, signal.SIGTERM)
LONGEST_SLEEP = 1.0  # s
# After which an interrupt that was lost is repeated.
REPEAT_S = 0.05


def no_progress(_what: str, _share: float) -> None:
    """An OnProgress that shows nothing."""


def python_command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module as `python -m` does, without the current folder's modules.

    `python -m` looks for every module in the current folder first: a numpy.py beside a downloaded
    recording would be run.  Option -I would ignore PYTHONPATH, too, by which ROS is found.
    """
    run = ["-P", "-m"] if sys.version_info >= (3, 11) else ["-c", RUN_MODULE]
    return [sys.executable, *run, module, *arguments]


def stopping_signals() -> list[int]:
    """Those of them that are to stop this process: `nohup` lets SIGHUP be ignored."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [number for number in NUMBERS if number != signal.SIGHUP or not ignored]


def ignore_signals() -> None:
    """To be called at the end of a process, which a late signal must not kill."""
    for number in (*NUMBERS, signal.SIGALRM):
        signal.signal(number, signal.SIG_IGN)


class StopSignal:
    """Set by the first of these signals.  To be made, and waited for, in the main thread.

    Signals after the first change nothing; also one that comes while the interpreter ends, and its
    handlers are gone.  by_signal: whether a signal came.
    """

    def __init__(self) -> None:
        # `put` may interrupt `get`, where Event.set would wait for a lock that Event.wait holds.
        self._news: SimpleQueue[None] = SimpleQueue()
        self._is_set = False
        self.by_signal = False
        for number in stopping_signals():
            signal.signal(number, self._on_signal)
        atexit.register(ignore_signals)

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self.by_signal = True
        self.set()

    def set(self) -> None:
        """End the waiting without a signal."""
        self._is_set = True
        self._news.put(None)

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until a signal comes or `set` is called; False where neither is within timeout s."""
        end = math.inf if timeout is None else time.monotonic() + timeout
        while not self._is_set and (left := end - time.monotonic()) > 0:
            # Python runs its handlers in the main thread, and a signal does not always wake it.
            with suppress(Empty):
                self._news.get(timeout=min(left, LONGEST_SLEEP))
        return self._is_set


class Interruption:
    """A context manager: these signals raise KeyboardInterrupt, also in what takes long to load.

    Python drops an exception that is raised within a finaliser, and C code that calls Python may
    drop any: the interrupt is repeated until it is seen to end what runs, without tracebacks.
    number: of the last signal that came; 0 for none.
    """

    def __init__(self) -> None:
        self.number = 0
        self._earlier: dict[int, Any] = {}
        self._excepthook = sys.excepthook

    def __enter__(self) -> Interruption:
        for number in (*stopping_signals(), signal.SIGALRM):
            self._earlier[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        if self.number == signal.SIGHUP:
            # A shell and the kernel send one each: the second must not disturb the end.
            self._earlier[signal.SIGHUP] = signal.SIG_IGN
        for number, handler in self._earlier.items():
            signal.signal(number, handler)
        sys.excepthook = self._excepthook

    @property
    def exit_code(self) -> int:
        """That of the signal that came; 0 for none."""
        return self.number and 128 + self.number

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        if number == self.number == signal.SIGHUP:
            return
        signal.setitimer(signal.ITIMER_REAL, REPEAT_S)
        if number == signal.SIGALRM and _is_being_interrupted():
            return
        if number != signal.SIGALRM:
            self.number = number
        # C code may print what it drops; and objects that are incomplete may raise in their
        # finalisers, until the process ends.
        sys.excepthook = sys.unraisablehook = _show_nothing
        raise KeyboardInterrupt


def _is_being_interrupted() -> bool:
    """Whether the code that a signal came in handles a KeyboardInterrupt, as in `finally`."""
    error = sys.exc_info()[1]
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None


def _show_nothing(*_: object) -> None:
    """In place of a hook that writes a traceback."""
