"""How far the middle of a dot's picture lies from the picture of its middle."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["centroid_bias"]


def centroid_bias(grid: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """Centroid of a disc's picture minus picture of its centre, (rows, cols, 2) px.

    grid (rows, cols, 2) px: pictures q(i, j) of the markers; radius: of the discs, in pitches.
    To the second order of the radius: r^2 / 8 laplacian(q) + r^2 / 4 (grad J . grad) q / J, with J
    the area that a pitch by a pitch has in the picture.  That covers perspective, the curvature of
    the gel and any deformation that the neighbours show; NaN where one of them is missing.
    """
    by_i, by_j = _slopes(grid)
    laplacian = _bends(grid, 0) + _bends(grid, 1)
    area = by_j[..., 0] * by_i[..., 1] - by_j[..., 1] * by_i[..., 0]
    slope_i, slope_j = _slopes(area[..., None])
    with np.errstate(divide="ignore", invalid="ignore"):
        drift = (slope_i * by_i + slope_j * by_j) / area[..., None]
    return np.asarray(radius**2 * (laplacian / 8 + drift / 4))


def _slopes(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.gradient(values, axis=0), np.gradient(values, axis=1)


def _bends(values: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Second differences; those of the borders are their neighbours'."""
    inner = np.diff(values, 2, axis=axis)
    width = [(0, 0)] * values.ndim
    width[axis] = (1, 1)
    return np.pad(inner, width, mode="edge")
