"""How well smooth curves fit the corners."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["curve_residual"]


def curve_residual(corners: NDArray[np.float64]) -> float:
    """RMS distance of corners (rows, cols, 2) from the cubics through their four neighbours, px.

    NaN where no corner has two measured neighbours on either side.
    """
    total, count = _squares(corners)
    # The combination's own noise is 1.39 times a corner's: scale back to one corner's.
    return float(np.sqrt(total / (count * (1 + 34 / 36)))) if count else float("nan")


@njit(cache=True, nogil=True)
def _squares(corners: NDArray[np.float64]) -> tuple[float, int]:
    """Sum of the squared distances in `curve_residual`, and how many there are."""
    rows, cols = corners.shape[:2]
    total, count = 0.0, 0
    for di, dj in ((1, 0), (0, 1)):
        for i in range(2 * di, rows - 2 * di):
            for j in range(2 * dj, cols - 2 * dj):
                square = 0.0
                for d in range(2):
                    near = corners[i - di, j - dj, d] + corners[i + di, j + dj, d]
                    far = corners[i - 2 * di, j - 2 * dj, d] + corners[i + 2 * di, j + 2 * dj, d]
                    square += (corners[i, j, d] - (4 * near - far) / 6) ** 2
                if np.isfinite(square):
                    total, count = total + square, count + 1
    return total, count
