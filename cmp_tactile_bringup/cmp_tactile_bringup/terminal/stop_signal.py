"""Waits for SIGINT, SIGTERM or, as a terminal or ssh is closed, SIGHUP.

rclpy's own handlers end the ROS context at once, under the feet of running callbacks.  These
only inform the main thread, which then destroys what there is in order and ends the context last.
Signals after the first change nothing; also one that comes while the interpreter ends, and its
handlers are gone, must not kill it.
"""

from __future__ import annotations

import atexit
import math
import signal
import time
from contextlib import suppress
from queue import Empty, SimpleQueue
from types import FrameType

NUMBERS = (signal.SIGINT, signal.SIGHUP, signal.SIGTERM)
LONGEST_SLEEP = 1.0  # s


def stopping_signals() -> list[int]:
    """Those of them that are to stop this process: `nohup` lets SIGHUP be ignored."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [number for number in NUMBERS if number != signal.SIGHUP or not ignored]


class StopSignal:
    """Set by the first of these signals.  To be made, and waited for, in the main thread.

    by_signal: whether a signal came.
    """

    def __init__(self) -> None:
        # `put` may interrupt `get`, where Event.set would wait for a lock that Event.wait holds.
        self._news: SimpleQueue[None] = SimpleQueue()
        self._is_set = False
        self.by_signal = False
        for number in stopping_signals():
            signal.signal(number, self._on_signal)
        atexit.register(_ignore)

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


def _ignore() -> None:
    for number in NUMBERS:
        signal.signal(number, signal.SIG_IGN)
