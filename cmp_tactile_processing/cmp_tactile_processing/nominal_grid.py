"""The pattern at rest as one view shows it: what the numbering is anchored to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cmp_tactile_processing.optics import ViewGeometry
from cmp_tactile_processing.pattern import Pattern

__all__ = ["NominalGrid"]


@dataclass(frozen=True)
class NominalGrid:
    """Nominal projection of the corners into one view.

    corners (rows, cols, 2) px; row_step, col_step (rows, cols, 2): px from a corner to the next
    along i and along j; side_px: median side of a checker; tree: nearest nominal corner.
    """

    corners: NDArray[np.float64]
    row_step: NDArray[np.float64]
    col_step: NDArray[np.float64]
    side_px: float
    smallest_side_px: float
    largest_side_px: float
    tree: cKDTree

    @classmethod
    def of_view(cls, pattern: Pattern, view: ViewGeometry) -> NominalGrid:
        """The nominal grid of a pattern at rest."""
        corners = view.project(pattern.corners())
        row_step = np.gradient(corners, axis=0)
        col_step = np.gradient(corners, axis=1)
        sides = np.concatenate(
            [np.linalg.norm(step, axis=-1).ravel() for step in (row_step, col_step)]
        )
        return cls(
            corners=corners,
            row_step=row_step,
            col_step=col_step,
            side_px=float(np.median(sides)),
            smallest_side_px=float(sides.min()),
            largest_side_px=float(sides.max()),
            tree=cKDTree(corners.reshape(-1, 2)),
        )

    def axes_near(self, q: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Steps along i and along j, (N, 2) px each, of the nominal corner nearest to q (N, 2)."""
        nearest = self.tree.query(q)[1]
        return self.row_step.reshape(-1, 2)[nearest], self.col_step.reshape(-1, 2)[nearest]
