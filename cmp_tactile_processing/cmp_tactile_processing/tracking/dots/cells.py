"""Where in an image the checkers around corners lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.tracking.corners.neighbours import predicted_places

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Cells:
    """The checkers that touch the corners of a lattice (R, C); checker (0, 0) lies before (0, 0).

    middle (R + 1, C + 1, 2) px; down, right (R + 1, C + 1, 2) px: along i and along j, from side to
    side.  NaN for checkers that touch no known corner.
    """

    middle: Float
    down: Float
    right: Float

    @classmethod
    def around(cls, lattice: Float) -> Cells:
        """The checkers around corners (R, C, 2) px, NaN where not known.

        Corners that are not known lie where their neighbours have them.
        """
        corners = np.pad(lattice, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
        seen = np.isfinite(corners[..., 0])
        for _ in range(2):
            corners = np.where(np.isnan(corners), predicted_places(corners), corners)
        touched = seen[:-1, :-1] | seen[:-1, 1:] | seen[1:, :-1] | seen[1:, 1:]
        corners = np.asarray(corners)
        first, last = corners[:-1], corners[1:]
        middle = (first[:, :-1] + first[:, 1:] + last[:, :-1] + last[:, 1:]) / 4
        down = (last[:, :-1] + last[:, 1:] - first[:, :-1] - first[:, 1:]) / 2
        right = (first[:, 1:] + last[:, 1:] - first[:, :-1] - last[:, :-1]) / 2
        known = touched[..., None]
        return cls(*(np.where(known, part, np.nan) for part in (middle, down, right)))

    def places(self, offsets: Float) -> Float:
        """Pixels (..., n, 2) at offsets (n, 2) from the middles, in sides along i and along j."""
        a, b = offsets[:, :1], offsets[:, 1:]
        return np.asarray(
            self.middle[..., None, :] + a * self.down[..., None, :] + b * self.right[..., None, :]
        )
