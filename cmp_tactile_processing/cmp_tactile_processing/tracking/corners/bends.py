"""How gridlines bend at their corners, as the corners around say, and what that moves.

The fit of a corner expects edges that are straight, and sees too little of them to say otherwise.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part

Float = NDArray[np.float64]
# Second differences flatten the crests of a curve.  Less this share of their own second differences
# they are right for waves of 3.7 checkers; for much longer ones, 1 / 12 would be.
SHARPEN = -1 / 8
# And this share takes a corner's own error out of its bend: for where all differences are noise.
SMOOTHEN = 1 / 3
# Degree of the curve through the virtual markers around a corner, of few and of more per segment.
LOW_DEGREE, FEW_MARKERS, DEGREE = 2, 3, 4
# Where these turn by more than this from checker to checker, rad, against what the corners show,
# they follow a ragged edge.
RAGGED_TURN = 0.2


def with_bends(
    corners: Float,
    std: Float,
    pull: Float,
    lines: tuple[Float, Float] | None = None,
) -> Float:
    """Corners (rows, cols, 2) px once their edges are expected to bend as the gridlines do.

    std (rows, cols) px; pull (rows, cols, 2, 4): as of `SaddlePoints`.  lines: virtual markers
    (rows, cols-1, n, 2) and (rows-1, cols, n, 2), px; without them bends are those that the
    corners themselves show.
    """
    rows, cols = corners.shape[:2]
    if lines is None:
        lines = np.empty((rows, cols - 1, 0, 2)), np.empty((rows - 1, cols, 0, 2))
    row_lines, col_lines = lines
    derivatives = _derivatives(col_lines.shape[2])
    moved: Float = corners.copy()
    _add_bends(corners, std, pull, (col_lines, derivatives), moved)
    across = (corners, std, pull, row_lines)
    corners, std, pull, row_lines = (np.ascontiguousarray(a.swapaxes(0, 1)) for a in across)
    _add_bends(corners, std, pull, (row_lines, derivatives), moved.swapaxes(0, 1))
    return moved


@lru_cache
def _derivatives(n: int) -> Float:
    """Weights (2, 2 n + 1) of the first and half the second derivative, per segment, at a corner.

    Of the n virtual markers before the corner, the corner and the n behind it; (0, 1) for n = 0.
    """
    place = np.arange(-n, n + 1) / (n + 1)
    degree = LOW_DEGREE if n <= FEW_MARKERS else DEGREE
    terms = np.vander(place, min(degree, 2 * n) + 1, increasing=True)
    return np.ascontiguousarray(np.linalg.pinv(terms)[1:3], dtype=np.float64)


@kernel_part
def _set_bends(corners: Float, bends: Float) -> None:
    """Half the second derivative along axis 0 from the next corner on each side, 1/px, or NaN."""
    bends[:] = np.nan
    for i in range(1, len(corners) - 1):
        for j in range(corners.shape[1]):
            here, before, after = corners[i, j], corners[i - 1, j], corners[i + 1, j]
            back = np.hypot(before[0] - here[0], before[1] - here[1])
            ahead = np.hypot(after[0] - here[0], after[1] - here[1])
            for d in range(2):
                turn = (before[d] - here[d]) / back + (after[d] - here[d]) / ahead
                bends[i, j, d] = turn / (back + ahead)


@kernel_part
def _set_crests(corners: Float, std: Float, bends: Float, crests: Float) -> float:
    """Second differences of the bends along axis 0, 0 where unknown; which share of it is noise."""
    crests[:] = 0.0
    noise = seen = 0.0
    for i in range(1, len(corners) - 1):
        for j in range(corners.shape[1]):
            step = np.hypot(
                corners[i + 1, j, 0] - corners[i, j, 0], corners[i + 1, j, 1] - corners[i, j, 1]
            )
            # The errors of five corners by half of (1, -4, 6, -4, 1).
            of_noise = 17.5 * (std[i, j] / (step * step)) ** 2
            for d in range(2):
                crest = bends[i - 1, j, d] - 2 * bends[i, j, d] + bends[i + 1, j, d]
                if not (np.isnan(crest) or np.isnan(of_noise)):
                    crests[i, j, d] = crest
                    noise += of_noise
                    seen += crest * crest
    return min(noise / seen, 1.0) if seen > 0 else 1.0


@kernel_part
def _see_bends(corners: Float, lines: tuple[Float, Float], trust: float, bends: Float) -> None:
    """Mix into the bends those that virtual markers (a - 1, b, n, 2) along axis 0 show."""
    markers, derivatives = lines
    n = markers.shape[2]
    slope, bend = np.empty((2, 2))
    for i in range(1, len(corners) - 1):
        for j in range(corners.shape[1]):
            for d in range(2):
                slope[d] = derivatives[0, n] * corners[i, j, d]
                bend[d] = derivatives[1, n] * corners[i, j, d]
                for k in range(n):
                    before, behind = markers[i - 1, j, k, d], markers[i, j, k, d]
                    slope[d] += derivatives[0, k] * before + derivatives[0, n + 1 + k] * behind
                    bend[d] += derivatives[1, k] * before + derivatives[1, n + 1 + k] * behind
            scale = 1 / (slope[0] * slope[0] + slope[1] * slope[1])
            x, y = bend[0] * scale - bends[i, j, 0], bend[1] * scale - bends[i, j, 1]
            # A bend is half a turn.
            share = trust / (1 + 4 * (x * x + y * y) / (scale * RAGGED_TURN * RAGGED_TURN))
            if np.isfinite(share):
                bends[i, j, 0] += share * x
                bends[i, j, 1] += share * y


@kernel
def _add_bends(
    corners: Float, std: Float, pull: Float, lines: tuple[Float, Float], moved: Float
) -> None:
    """Add to `moved` what bends along axis 0 pull each corner by."""
    bends, crests = np.empty_like(corners), np.empty_like(corners)
    _set_bends(corners, bends)
    noise = _set_crests(corners, std, bends, crests)
    bends += (SHARPEN + (SMOOTHEN - SHARPEN) * noise) * crests
    if lines[0].shape[2] > 0:
        _see_bends(corners, lines, 1 - noise, bends)
    last = len(corners) - 1
    for i in range(last + 1):
        for j in range(corners.shape[1]):
            near = i + 1 if i < last and not np.isnan(corners[i + 1, j, 0]) else i - 1
            bend = bends[i, j]
            if np.isnan(bend[0]) and near >= 0:
                # At the end of its gridline a corner bends as the next one does.
                bend = bends[near, j]
            if near < 0 or np.isnan(bend[0]):
                continue
            x, y = corners[near, j, 0] - corners[i, j, 0], corners[near, j, 1] - corners[i, j, 1]
            first, second = pull[i, j]
            is_first = abs(x * first[0] + y * first[1]) > abs(x * second[0] + y * second[1])
            edge = first if is_first else second
            across = edge[0] * bend[1] - edge[1] * bend[0]
            for d in range(2):
                moved[i, j, d] += edge[2 + d] * across
