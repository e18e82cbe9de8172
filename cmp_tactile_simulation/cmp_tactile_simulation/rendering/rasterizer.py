"""Draws a lattice of material points into the picture, the nearest in front."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["rasterize"]


@njit(cache=True, nogil=True, error_model="numpy")
def rasterize(
    seen: NDArray[np.float64],
    lattice: tuple[NDArray[np.float64], NDArray[np.float64]],
    out: NDArray[np.float64],
    border: int,
    band: tuple[int, int],
) -> None:
    """Fill the rows of a band (first, last + 1) of `out` (h, w, 4).

    out: material x, y (m), 1 / depth, and the pixel's size (m): mean of its sides on the skin.
    seen (rows, cols, 3): pixel and 1 / depth of the lattice's points.  lattice: their x (cols,)
    and y (rows,), m.  Pixel (0, 0) is out[border, border].  NaN where no triangle covers a pixel's
    centre; of several triangles the nearest, of equally near ones the first.
    """
    x, y = lattice
    out[band[0] : band[1]] = np.nan
    for row in range(seen.shape[0] - 1):
        for col in range(seen.shape[1] - 1):
            low = min(
                seen[row, col, 1],
                seen[row, col + 1, 1],
                seen[row + 1, col, 1],
                seen[row + 1, col + 1, 1],
            )
            high = max(
                seen[row, col, 1],
                seen[row, col + 1, 1],
                seen[row + 1, col, 1],
                seen[row + 1, col + 1, 1],
            )
            if high + border < band[0] or low + border > band[1] - 1:
                continue
            corner = (seen[row, col], x[col], y[row])
            across = (seen[row, col + 1], x[col + 1], y[row])
            along = (seen[row + 1, col], x[col], y[row + 1])
            opposite = (seen[row + 1, col + 1], x[col + 1], y[row + 1])
            _draw((corner, across, opposite), out, border, band)
            _draw((corner, opposite, along), out, border, band)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _slopes(triangle: Any, kind: Any, area: float) -> Any:
    """Change of a coordinate, 1 for x and 2 for y, along and across a pixel."""
    a, b, c = triangle
    first, second = b[kind] - a[kind], c[kind] - a[kind]
    right = first * (c[0][1] - a[0][1]) - second * (b[0][1] - a[0][1])
    down = second * (b[0][0] - a[0][0]) - first * (c[0][0] - a[0][0])
    return right / area, down / area


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _draw(triangle: Any, out: NDArray[np.float64], border: int, band: tuple[int, int]) -> None:
    a, b, c = triangle
    qa, qb, qc = a[0], b[0], c[0]
    area = (qb[0] - qa[0]) * (qc[1] - qa[1]) - (qb[1] - qa[1]) * (qc[0] - qa[0])
    if not abs(area) > 0:
        return
    xu, xv = _slopes(triangle, 1, area)
    yu, yv = _slopes(triangle, 2, area)
    size = (np.sqrt(xu * xu + yu * yu) + np.sqrt(xv * xv + yv * yv)) / 2
    share = 1 / area
    top = int(max(np.ceil(min(qa[1], qb[1], qc[1])) + border, band[0]))
    bottom = int(min(np.floor(max(qa[1], qb[1], qc[1])) + border, band[1] - 1))
    left = int(max(np.ceil(min(qa[0], qb[0], qc[0])) + border, 0))
    right = int(min(np.floor(max(qa[0], qb[0], qc[0])) + border, out.shape[1] - 1))
    for v in range(top, bottom + 1):
        for u in range(left, right + 1):
            px, py = u - border, v - border
            wa = ((qb[0] - px) * (qc[1] - py) - (qb[1] - py) * (qc[0] - px)) * share
            wb = ((qc[0] - px) * (qa[1] - py) - (qc[1] - py) * (qa[0] - px)) * share
            wc = 1 - wa - wb
            if wa < -1e-9 or wb < -1e-9 or wc < -1e-9:
                continue
            wa, wb, wc = wa * qa[2], wb * qb[2], wc * qc[2]
            near = wa + wb + wc
            if not out[v, u, 2] >= near:
                # Straight in space, not in the picture.
                far = 1 / near
                out[v, u, 0] = (wa * a[1] + wb * b[1] + wc * c[1]) * far
                out[v, u, 1] = (wa * a[2] + wb * b[2] + wc * c[2]) * far
                out[v, u, 2] = near
                out[v, u, 3] = size
