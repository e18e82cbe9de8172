"""The paper's local sub-pixel correction of virtual markers (III.C), compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cmp_tactile_processing.tracking.virtual_markers.placing import (
    MEASURED,
    MISSING,
    PREDICTED,
    Markers,
)
from cmp_tactile_processing.tracking.virtual_markers.ridge import Pixels, Segments

__all__ = ["CORNER_CLEARANCE", "WEAKEST_GRADIENT", "Zone", "correct_markers"]

Array = NDArray[np.float64]

# How far from the curve through the corners the gradient's peak is looked for, px.
SEARCH_PX = 2
REACH = SEARCH_PX + 2
# Closer to a corner than this many standard deviations of the edges' blur the crossing gridline
# bends the gradient's ridge.
CORNER_CLEARANCE = 3.0
# A gradient below this share of the median on all gridlines is no edge.
WEAKEST_GRADIENT = 0.25
# Grid-line points of one zone that differ by more lie on different edges, px.
LARGEST_STEP = 2.0
# A quadratic through three pixels of a bell is this much off without any noise, px.
MODEL_ERROR = 0.006
# Standard deviation of the curve between corners as a share of the segment's length.
CURVE_ERROR = 0.0008
UNKNOWN_CORNER = 0.05


class Zone(NamedTuple):
    """What a local zone must show.

    clearance: of the corners, px; weakest: gradient, grey / px; noise: standard deviation of half
    the difference of the gradients two pixels apart, grey / px.
    """

    clearance: float
    weakest: float
    noise: float


@njit(cache=True, nogil=True, error_model="numpy")
def _gridline_point(
    grey: NDArray[np.float32], base: int, stride: int
) -> tuple[float, float, float]:
    """Offset of the gradient's peak by a quadratic through three pixels, gradient and bend there.

    NaN where the largest gradient within the search is no peak.
    """
    best, top = 0, -1.0
    for offset in range(-SEARCH_PX, SEARCH_PX + 1):
        here = base + offset * stride
        value = abs(grey[here + stride] - grey[here - stride]) / 2
        if value > top:
            best, top = offset, value
    here = base + best * stride
    left = abs(grey[here] - grey[here - 2 * stride]) / 2
    right = abs(grey[here + 2 * stride] - grey[here]) / 2
    bend = left - 2 * top + right
    if not (bend < 0 and top >= left and top >= right):
        return math.nan, top, math.nan
    return best + (left - right) / 2 / bend, top, bend


@njit(cache=True, nogil=True, error_model="numpy")
def _corrected(
    pixels: Pixels, zone: Zone, axis: int, along: float, across: float
) -> tuple[float, float]:
    """Where the gridline passes `along`, and its standard deviation along the column; NaN: none.

    The straight line through the grid-line points of the two columns around it.
    """
    size, along_size, stride, along_stride = pixels.height, pixels.width, pixels.width, 1
    if axis == 1:
        size, along_size, stride, along_stride = pixels.width, pixels.height, 1, pixels.width
    column, row = math.floor(along), math.floor(across + 0.5)
    if column < 0 or column + 1 >= along_size or row < REACH or row + REACH >= size:
        return math.nan, math.nan
    base = column * along_stride + row * stride
    first, top, bend = _gridline_point(pixels.grey, base, stride)
    second, next_top, next_bend = _gridline_point(pixels.grey, base + along_stride, stride)
    if not (min(top, next_top) > zone.weakest and abs(second - first) < LARGEST_STEP):
        return math.nan, math.nan
    share = along - column
    std = math.hypot(zone.noise / min(-bend, -next_bend), MODEL_ERROR)
    return row + first * (1 - share) + second * share, std


@njit(cache=True, nogil=True, error_model="numpy")
def _correct_segment(
    pixels: Pixels, segments: Segments, zone: Zone, at: tuple[int, int, float], markers: Markers
) -> None:
    """at: the segment's indices and the standard deviation of its curve, px."""
    i, j, curve_std = at
    c, corners = segments.curve[i, j], segments.corners
    x, y = c[1, 0] + c[2, 0] + c[3, 0], c[1, 1] + c[2, 1] + c[3, 1]
    axis = 1 if abs(y) > abs(x) else 0
    tilt = max(abs(x), abs(y)) / math.hypot(x, y)
    n = markers.std.shape[2]
    for marker in range(n):
        t = (marker + 1) / (n + 1)
        point = markers.position[i, j, marker]
        for k in range(2):
            point[k] = ((c[3, k] * t + c[2, k]) * t + c[1, k]) * t + c[0, k]
        markers.status[i, j, marker] = PREDICTED
        markers.std[i, j, marker] = curve_std
        gap = math.hypot(point[0] - corners[i, j, 0], point[1] - corners[i, j, 1])
        far = math.hypot(point[0] - corners[i, j + 1, 0], point[1] - corners[i, j + 1, 1])
        doubtful = segments.doubtful.shape[2] > 0 and segments.doubtful[i, j, marker]
        if doubtful or min(gap, far) < zone.clearance:
            continue
        across, std = _corrected(pixels, zone, axis, point[axis], point[1 - axis])
        if math.isfinite(across):
            point[1 - axis] = across
            markers.status[i, j, marker] = MEASURED
            markers.std[i, j, marker] = std * tilt


@njit(cache=True, nogil=True, error_model="numpy")
def correct_markers(
    pixels: Pixels, segments: Segments, corner_std: Array, zone: Zone, markers: Markers
) -> None:
    """Fill the markers of the segments; corner_std (a, b+1) px.

    Markers without a clear peak, or too close to a corner, keep the curve's place as predicted.
    """
    for i in range(segments.curve.shape[0]):
        for j in range(segments.curve.shape[1]):
            c = segments.curve[i, j]
            x, y = c[1, 0] + c[2, 0] + c[3, 0], c[1, 1] + c[2, 1] + c[3, 1]
            if not (math.isfinite(x) and math.isfinite(y)):
                markers.position[i, j] = math.nan
                markers.std[i, j] = math.nan
                markers.status[i, j] = MISSING
                continue
            ends = 0.0
            for end in range(2):
                std = corner_std[i, j + end]
                ends = max(ends, std if math.isfinite(std) else UNKNOWN_CORNER)
            curve_std = math.hypot(ends, CURVE_ERROR * math.hypot(x, y))
            _correct_segment(pixels, segments, zone, (i, j, curve_std), markers)
