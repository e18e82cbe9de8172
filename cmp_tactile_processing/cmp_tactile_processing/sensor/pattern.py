"""The printed pattern: its surface at rest and where its corners lie on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.grid import GridShape

__all__ = ["Pattern", "PatternSurface"]


@dataclass(frozen=True)
class PatternSurface:
    """Shape of the undeformed marker surface: height over (x, y), gel frame, apex at z = 0.

    type: plane, sphere_cap (convex towards the object) or cylinder (its axis along `axis`).
    """

    type: str = "plane"
    radius: float = float("inf")
    axis: str = "x"

    def height(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height z in m at points (..., 2) in m; NaN outside the sphere or cylinder."""
        xy = np.asarray(xy, dtype=np.float64)
        if self.type == "plane":
            return np.zeros(xy.shape[:-1])
        if self.type == "sphere_cap":
            distance2 = (xy**2).sum(axis=-1)
        else:
            distance2 = xy[..., 1 if self.axis == "x" else 0] ** 2
        with np.errstate(invalid="ignore"):
            # Equal to sqrt(R^2 - d^2) - R, without its cancellation near the apex.
            return np.asarray(-distance2 / (self.radius + np.sqrt(self.radius**2 - distance2)))


@dataclass(frozen=True)
class Pattern:
    """A checkerboard of rows x cols inner corners, regular in x and y with the given pitch, m.

    corner_checker: dark or light, the checker outside corner (0, 0).
    """

    rows: int
    cols: int
    pitch: float
    corner_checker: str
    points_per_segment: int
    surface: PatternSurface

    @property
    def shape(self) -> GridShape:
        """Numbers of corners and virtual markers."""
        return GridShape(self.rows, self.cols, self.points_per_segment)

    def corners(self) -> NDArray[np.float64]:
        """Corners at rest, (rows, cols, 3) m, gel frame."""
        i, j = np.mgrid[: self.rows, : self.cols].astype(np.float64)
        return self.at(i, j)

    def at(self, i: NDArray[np.float64], j: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points of the undeformed surface at fractional rows i and columns j, (..., 3) m."""
        x = (j - (self.cols - 1) / 2) * self.pitch
        y = (i - (self.rows - 1) / 2) * self.pitch
        xy = np.stack([x, y], axis=-1)
        return np.concatenate([xy, self.surface.height(xy)[..., None]], axis=-1)
