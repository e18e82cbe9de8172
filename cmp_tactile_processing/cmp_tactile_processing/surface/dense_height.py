"""The height map of a dense surface: z over x and y in space, the shape of what touches the gel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_processing.surface.dense import DenseStatus, DenseSurface

__all__ = ["HeightMap", "height_map"]

# A point this far outside of a triangle, as a share of it, still lies on its border.
ON_BORDER = 1e-9


@dataclass(frozen=True)
class HeightMap:
    """Height of the deformed surface over places in space, gel frame, m; NaN where not known.

    grid: x and y of the places.  height (rows, cols); status (rows, cols): DenseStatus, the worst
    of the three nodes around.
    """

    grid: SurfaceGrid
    height: NDArray[np.float64]
    status: NDArray[np.uint8]


def height_map(dense: DenseSurface, grid: SurfaceGrid | None = None) -> HeightMap:
    """Height over a grid of places, by default over the x and y that the nodes have at rest.

    Linear between the dense surface's nodes: errs by the square of their spacing.  Where folds lie
    above each other, the outermost is told.  All missing for a monocular sensor.
    """
    grid = grid or dense.grid
    height = np.full((grid.rows, grid.cols), -np.inf)
    status = np.zeros(height.shape, np.uint8)
    origin, spacing = (grid.x[0], grid.y[0]), grid.spacing
    _draw(dense.position, dense.status, origin, spacing, height, status)
    height[status == DenseStatus.MISSING] = np.nan
    return HeightMap(grid, height, status)


@njit(cache=True, nogil=True)
def _draw(  # noqa: PLR0913, PLR0917 - nodes, raster, and what is drawn
    position: NDArray[np.float64],
    node_status: NDArray[np.uint8],
    origin: tuple[float, float],
    spacing: tuple[float, float],
    height: NDArray[np.float64],
    status: NDArray[np.uint8],
) -> None:
    """Each cell of nodes as two triangles, (x, y) in steps of the raster."""
    p = np.empty((4, 3))
    codes = np.empty(4, np.uint8)
    for i in range(position.shape[0] - 1):
        for j in range(position.shape[1] - 1):
            for k in range(4):
                a, b = i + k // 2, j + k % 2
                codes[k] = node_status[a, b]
                p[k, 0] = (position[a, b, 0] - origin[0]) / spacing[0]
                p[k, 1] = (position[a, b, 1] - origin[1]) / spacing[1]
                p[k, 2] = position[a, b, 2]
            for first in range(2):
                # Nodes 0, 1, 3 and 0, 3, 2 of the cell.
                second, third = (1, 3) if first == 0 else (3, 2)
                if codes[0] and codes[second] and codes[third]:
                    code = max(codes[0], codes[second], codes[third])
                    _draw_triangle(p[0], p[second], p[third], code, height, status)


@njit(cache=True, nogil=True)
def _draw_triangle(  # noqa: PLR0913, PLR0917 - three corners, and what is drawn
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    c: NDArray[np.float64],
    code: int,
    height: NDArray[np.float64],
    status: NDArray[np.uint8],
) -> None:
    twice_area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if twice_area == 0 or not np.isfinite(a[2] + b[2] + c[2]):
        return
    rows, cols = height.shape
    low_x = max(0, int(np.ceil(min(a[0], b[0], c[0]) - ON_BORDER)))
    high_x = min(cols - 1, int(np.floor(max(a[0], b[0], c[0]) + ON_BORDER)))
    low_y = max(0, int(np.ceil(min(a[1], b[1], c[1]) - ON_BORDER)))
    high_y = min(rows - 1, int(np.floor(max(a[1], b[1], c[1]) + ON_BORDER)))
    for y in range(low_y, high_y + 1):
        for x in range(low_x, high_x + 1):
            of_b = ((x - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (y - a[1])) / twice_area
            of_c = ((b[0] - a[0]) * (y - a[1]) - (x - a[0]) * (b[1] - a[1])) / twice_area
            if of_b < -ON_BORDER or of_c < -ON_BORDER or of_b + of_c > 1 + ON_BORDER:
                continue
            z = a[2] + of_b * (b[2] - a[2]) + of_c * (c[2] - a[2])
            if z > height[y, x]:
                height[y, x], status[y, x] = z, code
