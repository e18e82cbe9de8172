"""Curves through the corners: where a gridline runs between two of them, and how well they fit."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["curve_points", "curve_residual"]


def curve_points(corners: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Points on the cubic curves along axis 1 of corners (a, b, d), between neighbouring corners.

    Returns (a, b-1, count, d), equally spaced in the curve's parameter, which is the material
    coordinate along the gridline.  Tangents are central differences, one-sided next to missing
    corners; NaN only where an end of the segment is missing.
    """
    tangent = _tangents(corners)
    t = (np.arange(count) + 1.0) / (count + 1)
    h = np.stack(
        [2 * t**3 - 3 * t**2 + 1, t**3 - 2 * t**2 + t, -2 * t**3 + 3 * t**2, t**3 - t**2], axis=1
    )
    ends = np.stack([corners[:, :-1], tangent[:, :-1], corners[:, 1:], tangent[:, 1:]], axis=2)
    return np.asarray(np.einsum("kh,abhd->abkd", h, ends))


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


def _tangents(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    step = np.diff(corners, axis=1)
    edge = np.full_like(corners[:, :1], np.nan)
    before = np.concatenate([edge, step], axis=1)
    after = np.concatenate([step, edge], axis=1)
    central = (before + after) / 2
    # Parabolic ends: the central difference extrapolated from the next corner.
    inner_after = np.concatenate([central[:, 1:], edge], axis=1)
    inner_before = np.concatenate([edge, central[:, :-1]], axis=1)
    for fallback in (2 * after - inner_after, 2 * before - inner_before, after, before):
        central = np.where(np.isnan(central), fallback, central)
    return np.asarray(central)
