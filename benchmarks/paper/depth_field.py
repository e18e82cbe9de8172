"""The depth of a pressed marker surface, as a field over its material points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from cmp_tactile_processing.measured.surface import Surface
from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_processing.sensor.parts import Pattern
from cmp_tactile_processing.surface.dense import SurfaceInterpolator, grid_over
from cmp_tactile_simulation.rendering.surface import DeformedSurface

__all__ = ["DepthField", "nodes_of", "sampled", "true_displacement"]

Array = NDArray[np.float64]


class DepthField:
    """Interpolates the markers of one sensor to nodes so far apart, m; nothing is extrapolated."""

    def __init__(self, pattern: Pattern, spacing: float) -> None:
        self.grid = grid_over(pattern.shape, pattern.pitch, spacing)
        self._interpolator = SurfaceInterpolator(pattern.shape, pattern.pitch, self.grid)

    def displacement(self, surface: Surface) -> Array:
        """Displacement (rows, cols, 3) m at the nodes; NaN where nothing is known."""
        return self._interpolator.interpolate(surface).displacement

    def depth(self, surface: Surface) -> Array:
        """Depth (rows, cols) m at the nodes, along the gel's axis."""
        return -self.displacement(surface)[..., 2]


def true_displacement(surface: DeformedSurface, xy: Array) -> Array:
    """Displacement (..., 3) m of the material points at (x, y) (..., 2) m."""
    rest = np.concatenate([xy, surface.pattern.surface.height(xy)[..., None]], axis=-1)
    return np.asarray(surface.at_material(xy) - rest)


def nodes_of(grid: SurfaceGrid) -> Array:
    """Material coordinates of a grid's nodes, (rows, cols, 2) m."""
    return grid.points.reshape(grid.rows, grid.cols, 2)


def sampled(grid: SurfaceGrid, field: Array, xy: Array) -> Array:
    """A field (rows, cols) at places (n, 2) m, linearly between the nodes; NaN beyond them."""
    (dx, dy), (left, top) = grid.spacing, (grid.x[0], grid.y[0])
    places = np.stack([(xy[:, 1] - top) / dy, (xy[:, 0] - left) / dx])
    return np.asarray(map_coordinates(field, places, order=1, mode="constant", cval=np.nan))
