"""The rays of all pixels of a view, worked out once for a rig."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.optics import ViewGeometry

__all__ = ["BORDER", "PixelRays"]

# Pixels around the view that have rays too: what happens between two pixels depends on a third.
BORDER = 1


@dataclass(frozen=True)
class PixelRays:
    """Rays inside the gel of a view's pixels and of one more all around, gel frame.

    directions (height + 2, width + 2, 3), unit; origins of the same shape, m, or (1, 1, 3) where
    all rays have one.  NaN where a ray does not reach the gel.
    """

    origins: NDArray[np.float64]
    directions: NDArray[np.float64]

    @classmethod
    def from_view(cls, view: ViewGeometry) -> PixelRays:
        """The rays of a view's pixels."""
        width, height = view.placement.width, view.placement.height
        v, u = np.mgrid[-BORDER : height + BORDER, -BORDER : width + BORDER].astype(np.float64)
        origins, directions = view.rays(np.stack([u, v], axis=-1))
        if not view.layers:
            origins = view.centre.reshape(1, 1, 3)
        return cls(np.ascontiguousarray(origins), np.ascontiguousarray(directions))
