"""When the next event or attempt is due, and how the times of two clocks belong together."""

from __future__ import annotations

import time
from collections.abc import Callable


class BackOff:
    """delay: time before the next attempt, s; `first` to begin with, doubled up to `longest`."""

    def __init__(self, first: float, longest: float) -> None:
        self._first = first
        self._longest = max(first, longest)
        self.delay = first

    def wait_longer(self) -> None:
        """An attempt failed."""
        self.delay = min(2 * self.delay, self._longest)

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


READINGS = 3
# A thread that is interrupted between two clocks reads an offset that is off by that long.
MAX_READING_NS = 100_000
# A clock that is set, not slewed, is followed at once.
STEP_NS = 5_000_000
# Time in which a change of the offset is followed to two thirds.
SMOOTHING_NS = 1_000_000_000


class ClockOffset:
    """The difference of two clocks, smoothed; each `convert` follows it a little.

    other, monotonic: the clocks, ns.  NTP slews a clock by 0.5 ms a second at most, so the times
    are off by less than that; of a clock that is set again, such as by the start of a recording
    with /clock, the next time is already right.
    """

    def __init__(
        self, other: Callable[[], int], monotonic: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._other = other
        self._monotonic = monotonic
        self._offset_ns: float | None = None
        self._read_ns = 0

    @property
    def offset_ns(self) -> int:
        """The other clock's time less the monotonic one's, as it was last."""
        return round(self._offset_ns or 0)

    def convert(self, monotonic_ns: int) -> int:
        """The time of the other clock, ns."""
        self._follow()
        return monotonic_ns + self.offset_ns

    def _follow(self) -> None:
        spread, offset, now = min(self._reading() for _ in range(READINGS))
        before = self._offset_ns
        if before is None or abs(offset - before) > max(STEP_NS, spread):
            self._offset_ns, self._read_ns = float(offset), now
        elif spread <= MAX_READING_NS:
            elapsed = now - self._read_ns
            share = elapsed / (elapsed + SMOOTHING_NS)
            self._offset_ns, self._read_ns = before + share * (offset - before), now

    def _reading(self) -> tuple[int, int, int]:
        before = self._monotonic()
        other = self._other()
        after = self._monotonic()
        middle = (before + after) // 2
        return after - before, other - middle, after
