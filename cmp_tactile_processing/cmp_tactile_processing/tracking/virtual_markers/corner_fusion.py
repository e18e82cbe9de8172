"""Corners fused with the gridlines that were fitted through them.

A corner's own saddle is a small straight cross.  The fit of a segment beside it says where the
gridline passes it, from all that was measured along the segment and with the bend that this shows:
information across the line which the saddle has not.  A segment's fit has the corner among its
priors; that part of its information is taken out again, or the saddle would count twice.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.tracking.virtual_markers.fusion import CORNER_BIAS_PX, Fits, true_std

Array = NDArray[np.float64]
Index = NDArray[np.int64]
# Of the information of lines about a corner: the matrix (xx, xy, yy) 1 / px^2 and its product with
# the corner's shift (x, y).
LINE_ENTRIES = 5
# A line that is further off than this many standard deviations, from the saddle or from the same
# line beyond the corner, kinks there or has a flaw: it says nothing of the corner.
DISAGREEMENT = 2.5
# Lines that were fitted with a corner in the wrong place are off by this many times its error.
# Measured under a sphere that shears and twists the gel.
MISLED = 5.0


@kernel_part(forceinline=True)
def _line_at(c: Array, end: int, seen: tuple[float, float, float], line: Array) -> None:
    """Set (weight, offset, normal x, y) of a segment's line at one of its corners.

    seen: mean and variance of its place along an image axis, and the variance before it was seen.
    """
    mean, spread, prior = seen
    line[0] = 0.0
    if not 0 < spread < prior:
        return
    x, y = c[1, 0] + c[2, 0] + c[3, 0], c[1, 1] + c[2, 1] + c[3, 1]
    axis = 1 if abs(y) > abs(x) else 0
    along = c[1, axis] + end * (2 * c[2, axis] + 3 * c[3, axis])
    across = c[1, 1 - axis] + end * (2 * c[2, 1 - axis] + 3 * c[3, 1 - axis])
    slope = across / along
    scale = 1 / math.hypot(1, slope)
    weight = (1 / spread - 1 / prior) / scale**2
    offset = mean / (1 - spread / prior) * scale
    if offset * offset > DISAGREEMENT**2 * (1 / weight + prior * scale**2):
        return
    line[0], line[1] = weight, offset
    line[2 + axis], line[3 - axis] = -slope * scale, scale


@kernel_part(forceinline=True)
def _agree(first: Array, second: Array) -> bool:
    """Whether the line on both sides of a corner is one."""
    same_way = first[2] * second[2] + first[3] * second[3] > 0
    apart = first[1] - second[1] if same_way else first[1] + second[1]
    return bool(apart * apart < DISAGREEMENT**2 * (1 / first[0] + 1 / second[0]))


@kernel
def gather_lines(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    curve: Array, counts: Index, size: Array, end_std: Array, fits: Fits, sides: Array, found: Array
) -> None:
    """What the segments of curve (a, b, 4, 2) know of the corners at their ends.

    counts, size, end_std, fits: as for `fit_segments`, with a first and a last marker at the ends.
    sides (a, b+1, 2, 4): scratch.  found (a, b+1, LINE_ENTRIES): is set.
    """
    sides[:] = 0.0
    found[:] = 0.0
    last = len(fits.mean) - 1
    for i in range(curve.shape[0]):
        for j in range(curve.shape[1]):
            s = i * curve.shape[1] + j
            if counts[s] == 0 or not math.isfinite(curve[i, j, 3, 0] + curve[i, j, 3, 1]):
                continue
            for end in range(2):
                mean, spread = fits.mean[end * last, s], fits.spread[end * last, s]
                seen = (mean, spread, (end_std[end, s] * size[1, s]) ** 2)
                _line_at(curve[i, j], end, seen, sides[i, j + end, 1 - end])
    for i in range(found.shape[0]):
        for j in range(found.shape[1]):
            before, after = sides[i, j]
            if before[0] > 0 and after[0] > 0 and not _agree(before, after):
                continue
            for side in range(2):
                weight, offset, x, y = sides[i, j, side]
                found[i, j, 0] += weight * x * x
                found[i, j, 1] += weight * x * y
                found[i, j, 2] += weight * y * y
                found[i, j, 3] += weight * offset * x
                found[i, j, 4] += weight * offset * y


@kernel
def fused_corners(corners: Array, std: Array, fitted: Array, lines: Array) -> tuple[Array, Array]:
    """Corners (rows, cols, 2) px and their deviations per coordinate, with the lines' information.

    std (rows, cols) px of the saddles; fitted (rows, cols, 2): corners that the lines were fitted
    with; lines (rows, cols, LINE_ENTRIES): the sum of `gather_lines` of rows and columns.  Missing
    corners stay missing, and those of which the lines say nothing as they are.
    """
    fused, fused_std = np.empty(corners.shape), np.empty(std.shape)
    for i in range(len(corners)):
        for j in range(corners.shape[1]):
            own = 1 / std[i, j] ** 2
            x, y = corners[i, j, 0] - fitted[i, j, 0], corners[i, j, 1] - fitted[i, j, 1]
            xx, xy, yy = lines[i, j, 0], lines[i, j, 1], lines[i, j, 2]
            part = 1 / (1 + MISLED**2 * (xx + yy) * (x * x + y * y))
            # What the lines see from the corner where it is now.
            x, y = lines[i, j, 3] - xx * x - xy * y, lines[i, j, 4] - xy * x - yy * y
            xx, xy, yy = part * xx + own, part * xy, part * yy + own
            scale = 1 / (xx * yy - xy * xy)
            fused[i, j, 0] = corners[i, j, 0] + part * (yy * x - xy * y) * scale
            fused[i, j, 1] = corners[i, j, 1] + part * (xx * y - xy * x) * scale
            seen = xx + yy > 2 * own
            fused_std[i, j] = true_std((xx + yy) * scale / 2, CORNER_BIAS_PX) if seen else std[i, j]
    return fused, fused_std
