"""Keeps events at the intervals in which they were recorded."""

from __future__ import annotations

import time
from collections.abc import Callable

__all__ = ["Pacer"]

CATCH_UP = 0.02
"""How much lateness may be made good by shortening intervals, s."""


class Pacer:
    """Tells how long to wait before each event.

    An event that is late moves those after it instead of letting them follow in a bunch, which
    would overrun the queues of subscribers.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._due: float | None = None
        self._max_lateness = 0.0

    @property
    def max_lateness(self) -> float:
        """By how much the latest event missed its time, s."""
        return self._max_lateness

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
        self._max_lateness = max(self._max_lateness, now - due)
        self._due = max(due, now - CATCH_UP)
        return max(0.0, self._due - now)
