"""Turns times of the kernel's monotonic clock into times of another clock, such as that of ROS."""

from __future__ import annotations

import time
from collections.abc import Callable

__all__ = ["ClockOffset"]

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
    are off by less than that; of a clock that is set anew, such as by the start of a recording
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
