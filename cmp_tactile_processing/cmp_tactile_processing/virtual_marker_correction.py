"""The paper's local sub-pixel correction of virtual markers (III.C), compiled."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

__all__ = ["correct_markers"]

# How far from the curve through the corners the gradient's peak is looked for, px.
SEARCH_PX = 2
# Closer to a corner than this many standard deviations of the edges' blur the crossing gridline
# bends the gradient's ridge.
CORNER_CLEARANCE = 3.0
# A gradient below this share of the median on all gridlines is no edge.
WEAKEST_GRADIENT = 0.25
# Grid-line points of one zone that differ by more lie on different edges, px.
LARGEST_STEP = 2.0
# A zone's grid-line points are this much off with no noise (quadratic for a bell), px.
MODEL_ERROR = 0.01
# Standard deviation of the curve between corners as a share of the segment's length.
CURVE_ERROR = 0.005
UNKNOWN_CORNER = 0.05

NEVER, MEASURED, PREDICTED = 0, 1, 2


@njit(cache=True, nogil=True, error_model="numpy")
def _gridline_point(pixels, base, stride):  # type: ignore[no-untyped-def]
    """Offset of the gradient's peak by a quadratic through three pixels, and the gradient there.

    NaN where the largest gradient within the search has none around it.
    """
    best, top = 0, -1.0
    for offset in range(-SEARCH_PX, SEARCH_PX + 1):
        here = base + offset * stride
        value = abs(pixels[here + stride] - pixels[here - stride]) / 2
        if value > top:
            best, top = offset, value
    here = base + best * stride
    left = abs(pixels[here] - pixels[here - 2 * stride]) / 2
    right = abs(pixels[here + 2 * stride] - pixels[here]) / 2
    bend = left - 2 * top + right
    if not (bend < 0 and top >= left and top >= right):
        return math.nan, top, math.nan
    return best + (left - right) / 2 / bend, top, bend


@njit(cache=True, nogil=True, error_model="numpy")
def correct_markers(  # type: ignore[no-untyped-def]  # noqa: PLR0913, PLR0917
    pixels, width, height, corners, curve, corner_std, doubtful, settings, position, status, std
):
    """Correct the points of the curves: position (a, b, n, 2), status and std (a, b, n).

    pixels: smoothed image (height * width,); corners (a, b+1, 2); curve (a, b, 4, 2); corner_std
    (a, b+1); doubtful (a, b, n or 0); settings: clearance of corners px, weakest gradient,
    standard deviation of the noise of the quadratic's numerator (grey / px).
    """
    clearance, weakest, noise = settings
    n = position.shape[2]
    for i in range(curve.shape[0]):
        for j in range(curve.shape[1]):
            c = curve[i, j]
            x = c[1, 0] + c[2, 0] + c[3, 0]
            y = c[1, 1] + c[2, 1] + c[3, 1]
            if not (math.isfinite(x) and math.isfinite(y)):
                for marker in range(n):
                    position[i, j, marker, 0] = math.nan
                    position[i, j, marker, 1] = math.nan
                    status[i, j, marker] = NEVER
                    std[i, j, marker] = math.nan
                continue
            along_axis = 1 if abs(y) > abs(x) else 0
            along_size, across_size = (width, height) if along_axis == 0 else (height, width)
            along_stride, stride = (1, width) if along_axis == 0 else (width, 1)
            tilt = max(abs(x), abs(y)) / math.hypot(x, y)
            ends = 0.0
            for end in range(2):
                value = corner_std[i, j + end]
                ends = max(ends, value if math.isfinite(value) else UNKNOWN_CORNER)
            for marker in range(n):
                t = (marker + 1) / (n + 1)
                for axis in range(2):
                    position[i, j, marker, axis] = (
                        (c[3, axis] * t + c[2, axis]) * t + c[1, axis]
                    ) * t + c[0, axis]
                status[i, j, marker] = PREDICTED
                std[i, j, marker] = math.hypot(ends, CURVE_ERROR * math.hypot(x, y))
                p_x, p_y = position[i, j, marker]
                gap = math.hypot(p_x - corners[i, j, 0], p_y - corners[i, j, 1])
                end_gap = math.hypot(p_x - corners[i, j + 1, 0], p_y - corners[i, j + 1, 1])
                if min(gap, end_gap) < clearance:
                    continue
                if doubtful.shape[2] > 0 and doubtful[i, j, marker]:
                    continue
                along = p_x if along_axis == 0 else p_y
                across = p_y if along_axis == 0 else p_x
                column, row = int(math.floor(along)), int(math.floor(across + 0.5))
                reach = SEARCH_PX + 2
                if column < 0 or column + 1 >= along_size:
                    continue
                if row < reach or row + reach >= across_size:
                    continue
                base = column * along_stride + row * stride
                first, top, bend = _gridline_point(pixels, base, stride)
                second, next_top, next_bend = _gridline_point(pixels, base + along_stride, stride)
                if not (min(top, next_top) > weakest and abs(second - first) < LARGEST_STEP):
                    continue
                share = along - column
                line = row + first * (1 - share) + second * share
                position[i, j, marker, 1 - along_axis] = line
                status[i, j, marker] = MEASURED
                slack = noise / min(-bend, -next_bend)
                std[i, j, marker] = math.hypot(slack, MODEL_ERROR) * tilt
