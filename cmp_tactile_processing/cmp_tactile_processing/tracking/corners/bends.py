"""How gridlines bend at their corners, as the corners around say, and what that moves.

The fit of a corner expects edges that are straight, and sees too little of them to say otherwise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part

Float = NDArray[np.float64]
# Second differences flatten the crests of a curve.  Less this share of their own second differences
# they are right for waves of 3.7 checkers; for much longer ones, 1 / 12 would be.
SHARPEN = -1 / 8
# And this share takes a corner's own error out of its bend: for where all differences are noise.
SMOOTHEN = 1 / 3


def with_bends(corners: Float, std: Float, pull: Float) -> Float:
    """Corners (rows, cols, 2) px once their edges are expected to bend as the gridlines do.

    std (rows, cols) px; pull (rows, cols, 2, 4): as of `SaddlePoints`.
    """
    moved: Float = corners.copy()
    _add_bends(corners, std, pull, moved)
    across, std, pull = (np.ascontiguousarray(a.swapaxes(0, 1)) for a in (corners, std, pull))
    _add_bends(across, std, pull, moved.swapaxes(0, 1))
    return moved


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


@kernel
def _add_bends(corners: Float, std: Float, pull: Float, moved: Float) -> None:
    """Add to `moved` what bends along axis 0 pull each corner by."""
    bends, crests = np.empty_like(corners), np.empty_like(corners)
    _set_bends(corners, bends)
    noise = _set_crests(corners, std, bends, crests)
    bends += (SHARPEN + (SMOOTHEN - SHARPEN) * noise) * crests
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
