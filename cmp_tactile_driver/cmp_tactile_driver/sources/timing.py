"""When the next event or attempt is due, a thread of its own, and the times of two clocks."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable

from cmp_tactile_processing.errors import CmpTactileError


class BackOff:
    """delay: time before the next attempt, s; `first`, doubled after each up to ten times that."""

    def __init__(self, first: float) -> None:
        self._first = first
        self.delay = first

    def wait_longer(self) -> None:
        """An attempt failed."""
        self.delay = min(2 * self.delay, 10 * self._first)

    def reset(self) -> None:
        """An attempt worked."""
        self.delay = self._first


CATCH_UP = 0.02
"""How much lateness may be made good by shortening intervals, s."""


class Pacer:
    """Determines how long to wait before each event.

    An event that is late moves those after it instead of letting them follow in a bunch, which
    would overrun the queues of subscribers.

    max_lateness: by how much the latest event missed its time, s.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._due: float | None = None
        self.max_lateness = 0.0

    def restart(self) -> None:
        """Let the next event be due at once, as after a pause."""
        self._due = None

    def delay(self, interval: float) -> float:
        """Seconds to wait for an event that follows `interval` s after the last one."""
        now = self._clock()
        if self._due is None:
            self._due = now
            return 0.0
        due = self._due + interval
        self.max_lateness = max(self.max_lateness, now - due)
        self._due = max(due, now - CATCH_UP)
        return max(0.0, self._due - now)


READINGS = 5


def on_clock(
    monotonic_ns: int, other: Callable[[], int], monotonic: Callable[[], int] = time.monotonic_ns
) -> int:
    """A time of the monotonic clock on another clock, ns.

    By the reading of both clocks that was interrupted least of a few.
    """
    readings = []
    for _ in range(READINGS):
        before, there, after = monotonic(), other(), monotonic()
        readings.append((after - before, there - (before + after) // 2))
    return monotonic_ns + min(readings)[1]


class Worker:
    """Runs `work` on a thread of its own; `work` is to return soon after `stopping` is true.

    failure: why it failed, in one line; empty while it did not.
    """

    def __init__(self, name: str, work: Callable[[], None]) -> None:
        self._name = name
        self._work = work
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self.failure = ""

    @property
    def stopping(self) -> bool:
        """Whether it is to stop."""
        return self._stopping.is_set()

    def wait(self, duration: float) -> bool:
        """Pause the work for so many seconds, less where it is to stop; whether it is."""
        return self._stopping.wait(duration)

    def start(self) -> None:
        """Begin; may be called again after `stop`."""
        self._stopping.clear()
        self.failure = ""
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._thread.start()

    def request_stop(self) -> None:
        """Ask it to stop, without waiting."""
        self._stopping.set()

    def stop(self) -> None:
        """Stop, and wait for the thread unless it is the caller; may be called more than once."""
        self._stopping.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        try:
            self._work()
        except CmpTactileError as error:
            self.failure = str(error)
        except Exception as error:  # noqa: BLE001  the owner must learn of it, whatever it is
            traceback.print_exc()
            self.failure = f"{type(error).__name__}: {error}"
