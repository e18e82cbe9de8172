"""The marker surface of the gel in one state, as a smooth function of material coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_processing.sensor.pattern import Pattern
from cmp_tactile_simulation.rendering.surface_spline import (
    LEAST_POINTS,
    SplineSurface,
    spline_coefficients,
    surface_points,
)

__all__ = ["DeformedSurface"]


@dataclass(frozen=True)
class DeformedSurface:
    """Rest shape of the pattern plus a displacement known on a grid, gel frame, m.

    displacement (rows, cols, 3) m of the material points that lie on the grid's points at rest.
    Between them it is a bicubic spline through all of them, beyond the grid it goes on linearly.
    Raises GeometryError for another shape, fewer than 4 x 4 points or numbers that are not finite.
    """

    pattern: Pattern
    grid: SurfaceGrid
    displacement: NDArray[np.float64]

    def __post_init__(self) -> None:
        expected = (self.grid.rows, self.grid.cols, 3)
        found = np.shape(self.displacement)
        if found != expected or min(expected[:2]) < LEAST_POINTS:
            msg = (
                f"displacement: found shape {found}, expected {expected} "
                f"with at least {LEAST_POINTS} rows and columns"
            )
            raise GeometryError(msg)
        lost = int(np.count_nonzero(~np.isfinite(self.displacement)))
        if lost:
            msg = f"displacement: found {lost} numbers that are not finite, expected none"
            raise GeometryError(msg)

    @classmethod
    def rest(cls, pattern: Pattern) -> DeformedSurface:
        """The undeformed surface."""
        extent = (pattern.cols - 1) * pattern.pitch, (pattern.rows - 1) * pattern.pitch
        grid = SurfaceGrid(LEAST_POINTS, LEAST_POINTS, extent)
        return cls(pattern, grid, np.zeros((LEAST_POINTS, LEAST_POINTS, 3)))

    def at(self, i: NDArray[np.float64], j: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions (..., 3) m of the material points at fractional rows i and columns j.

        Corner (i, j) of the pattern is at whole numbers; NaN outside the sphere or cylinder.
        """
        return self.at_material(self.material(i, j))

    def material(self, i: NDArray[np.float64], j: NDArray[np.float64]) -> NDArray[np.float64]:
        """Material coordinates (x, y) (..., 2) m of fractional rows i and columns j."""
        i, j = np.broadcast_arrays(np.asarray(i, dtype=np.float64), np.asarray(j, np.float64))
        x = (j - (self.pattern.cols - 1) / 2) * self.pattern.pitch
        y = (i - (self.pattern.rows - 1) / 2) * self.pattern.pitch
        return np.stack([x, y], axis=-1)

    def at_material(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions (..., 3) m of the material points that lay at (x, y) (..., 2) m at rest."""
        flat = np.ascontiguousarray(xy, dtype=np.float64).reshape(-1, 2)
        return np.asarray(surface_points(self.spline(), flat)).reshape(*np.shape(xy)[:-1], 3)

    def corners(self) -> NDArray[np.float64]:
        """The pattern's corners, (rows, cols, 3) m."""
        i, j = np.mgrid[: self.pattern.rows, : self.pattern.cols].astype(np.float64)
        return self.at(i, j)

    def spline(self, size: tuple[float, float] = (np.inf, np.inf)) -> SplineSurface:
        """What compiled code needs of it; beyond `size` (x, y) m the rest shape goes on flat."""
        return SplineSurface.from_grid(self.pattern.surface, self.grid, self._coefficients, size)

    @cached_property
    def _coefficients(self) -> NDArray[np.float64]:
        return spline_coefficients(np.asarray(self.displacement, dtype=np.float64))
