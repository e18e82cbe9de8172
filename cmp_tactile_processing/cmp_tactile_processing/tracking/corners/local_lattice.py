"""What the neighbours in the grid tell of a corner: steps along the gridlines, its place."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["border_of", "local_steps", "outside_corners", "place_between", "predicted_places"]


def local_steps(
    corners: NDArray[np.float64],
    nominal_row_step: NDArray[np.float64],
    nominal_col_step: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Steps along i and along j at corners (rows, cols, 2) px, (rows, cols, 2) px each.

    Half the way between the neighbours on either side, the way to the one that is known, or the
    nominal step where none is.
    """
    row_step, col_step = np.empty_like(corners), np.empty_like(corners)
    _steps(corners, nominal_row_step, row_step)
    _steps(corners.swapaxes(0, 1), nominal_col_step.swapaxes(0, 1), col_step.swapaxes(0, 1))
    return row_step, col_step


def predicted_places(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where the neighbours put each corner of (rows, cols, 2) px, known or not; else NaN.

    The mean over both gridlines of what two neighbours in a row leave room for.
    """
    places = np.empty_like(corners)
    _places(corners, places)
    return places


def place_between(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where the cubics through two neighbours on either side put each corner, (rows, cols, 2) px.

    The middle of the two neighbours where further ones are missing; the mean over both gridlines;
    NaN for corners without known neighbours on either side along some gridline.
    """
    places = np.empty_like(corners)
    _between(corners, places)
    return places


def border_of(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values (rows, cols, d) along i = 0, the last i, j = 0, the last j: (2 (rows + cols), d)."""
    return np.concatenate([values[0], values[-1], values[:, 0], values[:, -1]])


def outside_corners(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where a further line of corners would lie beyond each side of a grid (rows, cols, 2) px.

    In the order of `border_of`.
    """
    inwards = np.concatenate([corners[1], corners[-2], corners[:, 1], corners[:, -2]])
    return np.asarray(2 * border_of(corners) - inwards)


@njit(cache=True, nogil=True)
def _steps(
    corners: NDArray[np.float64], nominal: NDArray[np.float64], step: NDArray[np.float64]
) -> None:
    rows, cols = corners.shape[:2]
    for i in range(rows):
        for j in range(cols):
            first, last = i, i
            if i > 0 and not np.isnan(corners[i - 1, j, 0]):
                first = i - 1
            if i + 1 < rows and not np.isnan(corners[i + 1, j, 0]):
                last = i + 1
            known = not np.isnan(corners[i, j, 0])
            for d in range(2):
                if last - first == 2 or (known and last > first):
                    step[i, j, d] = (corners[last, j, d] - corners[first, j, d]) / (last - first)
                else:
                    step[i, j, d] = nominal[i, j, d]


@njit(cache=True, nogil=True)
def _places(corners: NDArray[np.float64], places: NDArray[np.float64]) -> None:
    rows, cols = corners.shape[:2]
    for i in range(rows):
        for j in range(cols):
            count, x, y = 0, 0.0, 0.0
            for di, dj in ((1, 0), (0, 1)):
                for near, far in ((-1, 1), (-1, -2), (1, 2)):
                    a, b = i + near * di, j + near * dj
                    c, d = i + far * di, j + far * dj
                    if min(a, b, c, d) < 0 or max(a, c) >= rows or max(b, d) >= cols:
                        continue
                    weight = 0.5 if far == 1 else 2.0
                    u = weight * corners[a, b, 0] + (1.0 - weight) * corners[c, d, 0]
                    v = weight * corners[a, b, 1] + (1.0 - weight) * corners[c, d, 1]
                    if not np.isnan(u):
                        x, y, count = x + u, y + v, count + 1
            places[i, j, 0] = x / count if count else np.nan
            places[i, j, 1] = y / count if count else np.nan


@njit(cache=True, nogil=True)
def _between(corners: NDArray[np.float64], places: NDArray[np.float64]) -> None:
    rows, cols = corners.shape[:2]
    for i in range(rows):
        for j in range(cols):
            for d in range(2):
                count, total = 0, 0.0
                for di, dj in ((1, 0), (0, 1)):
                    if i < di or j < dj or i + di >= rows or j + dj >= cols:
                        continue
                    near = corners[i - di, j - dj, d] + corners[i + di, j + dj, d]
                    value = near / 2.0
                    if i >= 2 * di and j >= 2 * dj and i + 2 * di < rows and j + 2 * dj < cols:
                        far = (
                            corners[i - 2 * di, j - 2 * dj, d] + corners[i + 2 * di, j + 2 * dj, d]
                        )
                        if not np.isnan(far):
                            value = (4.0 * near - far) / 6.0
                    if not np.isnan(value):
                        total, count = total + value, count + 1
                places[i, j, d] = total / count if count else np.nan
