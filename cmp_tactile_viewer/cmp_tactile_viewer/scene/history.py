"""What the plots show: figures of the last minutes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_viewer.snapshot import Snapshot

FIGURES = (
    "time_s", "fx", "fy", "fz", "std_x", "std_y", "std_z", "contact", "slip_ratio", "latency_ms",
    "rate_hz",
)  # fmt: skip
# Two minutes at 60 Hz.
CAPACITY = 7200
# A plot has no more pixels than that.
MOST_POINTS = 300
# The rate is that of so many frames.
RATE_FRAMES = 30


class History:
    """Keeps the figures of the last CAPACITY snapshots in a ring."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        # Each row is kept twice, a capacity apart: the newest are then always in one piece.
        self._table = np.full((2 * capacity, len(FIGURES)), np.nan)
        self._capacity = capacity
        self._count = 0
        self._begin_ns: int | None = None

    @property
    def length_s(self) -> float:
        """From the oldest kept to the newest, s."""
        times = self._ordered()[:, 0]
        return float(times[-1] - times[0]) if len(times) > 1 else 0.0

    def add(self, snapshot: Snapshot) -> None:
        """Take a snapshot in; one that is not later than the last begins a new history.

        Times count from the earliest snapshot ever seen, also after a recording is gone back in.
        """
        if self._begin_ns is None or snapshot.stamp_ns < self._begin_ns:
            self._count, self._begin_ns = 0, snapshot.stamp_ns
        time_s = (snapshot.stamp_ns - self._begin_ns) * 1e-9
        if self._count and time_s <= self._ordered()[-1, 0]:
            self._count = 0
        row = np.full(len(FIGURES), np.nan)
        row[0] = time_s
        row[9] = 1e3 * snapshot.latency_s
        if snapshot.force is not None:
            force = snapshot.force
            row[1:4], row[4:7] = force.wrench[:3], force.wrench_std[:3]
            row[7] = 1.0 if force.contacts else 0.0
            row[8] = force.slip.slip_ratio
        recent = self._ordered()[-RATE_FRAMES:, 0]
        row[10] = snapshot.rate_hz
        if np.isnan(row[10]) and len(recent):
            row[10] = len(recent) / (time_s - recent[0])
        place = self._count % self._capacity
        self._table[[place, place + self._capacity]] = row
        self._count += 1

    def clear(self) -> None:
        """Forget all."""
        self._count, self._begin_ns = 0, None

    def window(self, length_s: float, back_s: float = 0.0) -> dict[str, NDArray[np.float64]]:
        """The figures from `length_s` before the end, which lies `back_s` before the newest.

        No more than MOST_POINTS; one point, all NaN, where nothing is known.
        """
        rows = self._ordered()
        if not len(rows):
            rows = np.full((1, len(FIGURES)), np.nan)
            rows[0, 0] = 0.0
        end = rows[-1, 0] - back_s
        first, last = np.searchsorted(rows[:, 0], (end - length_s, end + 1e-9))
        chosen = rows[first : max(last, first + 1)]
        if len(chosen) > MOST_POINTS:
            chosen = chosen[np.linspace(0, len(chosen) - 1, MOST_POINTS).astype(int)]
        return dict(zip(FIGURES, np.ascontiguousarray(chosen.T), strict=True))

    def _ordered(self) -> NDArray[np.float64]:
        """The rows that are kept, the oldest first."""
        first = self._count % self._capacity if self._count > self._capacity else 0
        return self._table[first : first + min(self._count, self._capacity)]
