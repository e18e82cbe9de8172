"""How much of the pattern is tracked, and how often it was lost and found again."""

from __future__ import annotations

import math
import time
from collections import deque

__all__ = ["PatternWatch"]

MEMORY_S = 60.0
MOST_LOSSES = 1001


class PatternWatch:
    """Follows the tracked fraction of the frames; `fraction` is the last one, NaN before it."""

    def __init__(self) -> None:
        self.fraction = math.nan
        self.losses = 0
        self.found = 0
        self._is_lost = False
        self._recent: deque[float] = deque(maxlen=MOST_LOSSES)

    def add(self, fraction: float, lost_below: float, found_from: float) -> None:
        """The share of the pattern that a frame shows; before it is found first it is not lost."""
        seen_before = not math.isnan(self.fraction)
        self.fraction = fraction
        if self._is_lost:
            if fraction >= found_from:
                self._is_lost = False
                self.found += 1
        elif fraction < lost_below:
            self._is_lost = True
            if seen_before:
                self.losses += 1
                self._recent.append(time.monotonic())

    def lost_lately(self) -> int:
        """How often it was lost within the last minute."""
        while self._recent and time.monotonic() - self._recent[0] > MEMORY_S:
            self._recent.popleft()
        return len(self._recent)
