"""How old the camera frames of a node's results are."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

__all__ = ["LatencyWatch"]

# No queue of ours holds a frame that long: such stamps are of another clock.
OLDEST_S = 10.0
# A simulated clock may come after the frame that it belongs to.
EARLIEST_S = -0.1
MOST_FRAMES = 4096


class LatencyWatch:
    """Ages of the results since the last `close_period`, and how many were late since the start."""

    def __init__(self) -> None:
        self.late = 0
        self._ages: deque[float] = deque(maxlen=MOST_FRAMES)
        self._other_clock = 0
        self._last_age = math.nan

    def add(self, age_s: float, late_after: float) -> None:
        """A result of a camera frame that was stamped `age_s` ago; NaN: not known."""
        if EARLIEST_S < age_s < OLDEST_S:
            self._ages.append(max(age_s, 0.0))
            self.late += age_s > late_after
        elif age_s == age_s:  # noqa: PLR0124  not NaN
            self._other_clock += 1
            self._last_age = age_s

    @property
    def known(self) -> bool:
        """Whether the frames of this period tell their age."""
        return len(self._ages) > self._other_clock

    def figures(self) -> dict[str, object]:
        """Median and 99th percentile of the period, or why they cannot be told."""
        if self.known:
            median, high = np.percentile(self._ages, (50, 99)) * 1e3
            return {"latency median (ms)": f"{median:.1f}", "latency p99 (ms)": f"{high:.1f}"}
        told = "no frames"
        if self._other_clock:
            off = -self._last_age
            told = (
                f"not known: stamps are {off:+.0f} s off the clock, as in a replay without /clock"
            )
        return {"latency median (ms)": told, "latency p99 (ms)": told}

    def close_period(self) -> None:
        """Begin the next."""
        self._ages.clear()
        self._other_clock = 0
