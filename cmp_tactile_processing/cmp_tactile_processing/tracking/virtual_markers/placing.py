"""Virtual markers from the fits of their segments: mean over the roughnesses, status, deviation."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cmp_tactile_processing.measured.grid import Status

__all__ = ["Markers", "place_markers", "set_sizes"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# A marker farther than this from every measured column along the gridline is predicted, px.
NEAR_PX = 2.0
MISSING, MEASURED, PREDICTED = (int(status) for status in Status)


class Markers(NamedTuple):
    """position (a, b, n, 2) px, status (a, b, n), std (a, b, n): across the gridline, px."""

    position: Array
    status: NDArray[np.uint8]
    std: Array

    @classmethod
    def from_segment(cls, a: int, b: int, n: int) -> Markers:
        """Buffers for n markers on each of a x b segments."""
        status = np.empty((a, b, n), dtype=np.uint8)
        return cls(np.empty((a, b, n, 2)), status, np.empty((a, b, n)))


@njit(cache=True, nogil=True, error_model="numpy")
def set_sizes(curve: Array, corner_std: Array, size: Array, end_std: Array) -> None:
    """Length and tilt (2, s) of the segments of curve (a, b, 4, 2); std (2, s) of their ends.

    corner_std (a, b+1).  Tilt: what a distance across the segment is along an image axis.
    """
    for i in range(curve.shape[0]):
        for j in range(curve.shape[1]):
            s = i * curve.shape[1] + j
            x = abs(curve[i, j, 1, 0] + curve[i, j, 2, 0] + curve[i, j, 3, 0])
            y = abs(curve[i, j, 1, 1] + curve[i, j, 2, 1] + curve[i, j, 3, 1])
            known = math.isfinite(x) and math.isfinite(y) and x + y > 0
            size[0, s] = math.hypot(x, y) if known else 1.0
            size[1, s] = size[0, s] / max(x, y) if known else 1.0
            end_std[0, s] = corner_std[i, j]
            end_std[1, s] = corner_std[i, j + 1]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _is_near(columns: Array, count: int, s: int, t: float, near: float) -> bool:
    seen = column = 0
    while seen < count:
        if columns[2, column, s] > 0:
            seen += 1
            if abs(columns[0, column, s] - t) < near:
                return True
        column += 1
    return False


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _mixture(
    deviation: Array, variance: Array, evidence: Array, share: Array, at: tuple[int, int]
) -> tuple[float, float]:
    """Mean and variance over the roughnesses at a marker of a segment."""
    marker, s = at
    total = mean = square = 0.0
    for model in range(len(share)):
        weight = share[model] * evidence[model, s]
        value = deviation[model, marker, s]
        total += weight
        mean += weight * value
        square += weight * (variance[model, marker, s] + value * value)
    mean /= total
    return mean, max(square / total - mean * mean, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def place_markers(
    curve: Array,
    counts: Index,
    columns: Array,
    fits: tuple[Array, Array, Array, Array],
    markers: Markers,
) -> None:
    """Fill the markers from the cubics (a, b, 4, 2), `measure`'s columns and `Fits`."""
    deviation, variance, evidence, share = fits
    n = markers.std.shape[2]
    for i in range(curve.shape[0]):
        for j in range(curve.shape[1]):
            c = curve[i, j]
            x = c[1, 0] + c[2, 0] + c[3, 0]
            y = c[1, 1] + c[2, 1] + c[3, 1]
            if not (math.isfinite(x) and math.isfinite(y)):
                markers.position[i, j] = math.nan
                markers.std[i, j] = math.nan
                markers.status[i, j] = MISSING
                continue
            s = i * curve.shape[1] + j
            axis = 1 if abs(y) > abs(x) else 0
            tilt = math.hypot(x, y) / max(abs(x), abs(y), 1e-9)
            near = NEAR_PX / max(abs(x), abs(y), 1e-9)
            for marker in range(n):
                t = (marker + 1) / (n + 1)
                for k in range(2):
                    value = ((c[3, k] * t + c[2, k]) * t + c[1, k]) * t + c[0, k]
                    markers.position[i, j, marker, k] = value
                mean, spread = _mixture(deviation, variance, evidence, share, (marker, s))
                markers.position[i, j, marker, 1 - axis] += mean
                markers.std[i, j, marker] = math.sqrt(spread) / tilt
                is_measured = _is_near(columns, counts[s], s, t, near)
                markers.status[i, j, marker] = MEASURED if is_measured else PREDICTED
