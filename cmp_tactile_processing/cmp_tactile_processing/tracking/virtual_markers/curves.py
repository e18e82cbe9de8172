"""Cubic curves through the corners of a grid, compiled: where the gridlines about run."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["fit_curves", "set_tangents"]

Array = NDArray[np.float64]


@njit(cache=True, nogil=True, error_model="numpy")
def set_tangents(corners: Array, tangent: Array) -> None:
    """Tangents along axis 1 of corners (a, b, 2), px per segment; NaN where nothing is known.

    Central differences; next to missing corners and at the ends, those of the parabola through
    the next two corners, or the one difference that there is.
    """
    for i in range(corners.shape[0]):
        last = corners.shape[1] - 1
        for j in range(last + 1):
            for axis in range(2):
                here = corners[i, j, axis]
                before = here - corners[i, j - 1, axis] if j > 0 else math.nan
                after = corners[i, j + 1, axis] - here if j < last else math.nan
                if not math.isnan(before) and not math.isnan(after):
                    value = (before + after) / 2
                elif not math.isnan(after):
                    value = after
                    if j + 2 <= last and not math.isnan(corners[i, j + 2, axis]):
                        next_after = corners[i, j + 2, axis] - corners[i, j + 1, axis]
                        value = (3 * after - next_after) / 2
                else:
                    value = before
                    if (
                        j >= 2
                        and not math.isnan(before)
                        and not math.isnan(corners[i, j - 2, axis])
                    ):
                        next_before = corners[i, j - 1, axis] - corners[i, j - 2, axis]
                        value = (3 * before - next_before) / 2
                tangent[i, j, axis] = value


@njit(cache=True, nogil=True, error_model="numpy")
def fit_curves(corners: Array, tangent: Array, curve: Array) -> None:
    """Coefficients of the cubic of each segment along axis 1, into curve (a, b-1, 4, 2).

    Point at t from 0 to 1: ((c3 t + c2) t + c1) t + c0; NaN where an end is missing.
    """
    for i in range(corners.shape[0]):
        for j in range(corners.shape[1] - 1):
            for axis in range(2):
                start, end = corners[i, j, axis], corners[i, j + 1, axis]
                leave, arrive = tangent[i, j, axis], tangent[i, j + 1, axis]
                curve[i, j, 0, axis] = start
                curve[i, j, 1, axis] = leave
                curve[i, j, 2, axis] = 3 * (end - start) - 2 * leave - arrive
                curve[i, j, 3, axis] = 2 * (start - end) + leave + arrive
