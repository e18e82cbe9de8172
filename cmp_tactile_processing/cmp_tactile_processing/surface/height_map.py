"""The height of the dense surface over places in space, for the shape of what touches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.surface.dense import DenseStatus, DenseSurface

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
    above each other, the outermost counts.  All missing for a monocular sensor.
    """
    grid = grid or dense.grid
    height = np.full((grid.rows, grid.cols), -np.inf)
    status = np.zeros(height.shape, np.uint8)
    corners, codes = _triangles(dense)
    corners[..., :2] = (corners[..., :2] - (grid.x[0], grid.y[0])) / grid.spacing
    low = np.ceil(corners[..., :2].min(axis=1) - ON_BORDER).astype(np.intp)
    size = np.floor(corners[..., :2].max(axis=1) + ON_BORDER).astype(np.intp) - low + 1
    for dx, dy in np.ndindex(*size.max(axis=0, initial=0)):
        reaching = np.flatnonzero((size > (dx, dy)).all(axis=1))
        _draw(corners[reaching], low[reaching] + (dx, dy), codes[reaching], height, status)
    height[status == DenseStatus.MISSING] = np.nan
    return HeightMap(grid, height, status)


def _triangles(dense: DenseSurface) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Two triangles (n, 3, 3) of known nodes for each cell, m; the worst status of the nodes."""
    nodes = np.arange(dense.status.size).reshape(dense.status.shape)
    a, b, c, d = nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]
    corners = np.stack([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)
    status, position = dense.status.ravel()[corners], dense.position.reshape(-1, 3)[corners]
    known = (status > 0).all(axis=1) & np.isfinite(position[..., 2]).all(axis=1)
    return position[known], status[known].max(axis=1)


def _draw(
    corners: NDArray[np.float64],
    pixel: NDArray[np.intp],
    codes: NDArray[np.uint8],
    height: NDArray[np.float64],
    status: NDArray[np.uint8],
) -> None:
    """Draw one pixel, (x, y), of each triangle where it lies within; in steps of the raster."""
    a, b, c = (corners[:, k] for k in range(3))
    ab, ac, ap = b - a, c - a, pixel - a[:, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        twice_area = ab[:, 0] * ac[:, 1] - ac[:, 0] * ab[:, 1]
        of_b = (ap[:, 0] * ac[:, 1] - ac[:, 0] * ap[:, 1]) / twice_area
        of_c = (ab[:, 0] * ap[:, 1] - ap[:, 0] * ab[:, 1]) / twice_area
    rows, cols = pixel[:, 1], pixel[:, 0]
    within = (of_b >= -ON_BORDER) & (of_c >= -ON_BORDER) & (of_b + of_c <= 1 + ON_BORDER)
    within &= (rows >= 0) & (cols >= 0) & (rows < height.shape[0]) & (cols < height.shape[1])
    z, at = (a[:, 2] + of_b * ab[:, 2] + of_c * ac[:, 2])[within], (rows[within], cols[within])
    np.maximum.at(height, at, z)
    top = z >= height[at]
    status[at[0][top], at[1][top]] = codes[within][top]
