"""Knocks of any size, cut from a slow stroke: frames of it are left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from paper.mechanics import Mechanics

__all__ = ["StrokePath"]

# Markers move by so many pitches from frame to frame on the way to where a knock begins.
SLOW = 0.2


@dataclass(frozen=True)
class StrokePath:
    """Frames of a stroke by how far the gel has gone.

    close: frames that press the bar in, before it is anywhere aside.  frames: of the stroke.
    travel: pitches that the marker which moves furthest has gone in each of these from the
    stroke's middle, negative before it.
    """

    close: tuple[int, ...]
    frames: NDArray[np.intp]
    travel: NDArray[np.float64]

    @classmethod
    def from_mechanics(cls, mechanics: Mechanics, pitch: float) -> StrokePath:
        """Of a scene with the phases close and stroke."""
        frames = mechanics.frames("stroke")
        moved = mechanics.displacement[frames] - mechanics.displacement[frames[0]]
        travel = np.linalg.norm(moved, axis=-1).max(axis=(1, 2)) / pitch
        close = tuple(mechanics.frames("rest", "close").tolist())[::2]
        return cls(close, frames, travel - travel[-1] / 2)

    def to_start(self, start: float) -> list[int]:
        """Frames from the gel at rest to where the bar has gone `start` pitches aside."""
        steps = max(int(np.ceil(abs(start) / SLOW)), 1)
        return [*self.close, *(self._nearest(start * k / steps) for k in range(steps + 1))]

    def knock(self, size: float, sign: int) -> list[int]:
        """The frames before and after a knock by `size` pitches across the middle.

        sign: 1 forwards, -1 backwards.
        """
        return [self._nearest(sign * size * share) for share in (-0.5, 0.5)]

    def _nearest(self, travel: float) -> int:
        return int(self.frames[np.argmin(np.abs(self.travel - travel))])
