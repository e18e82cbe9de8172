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
# Highest degree of the curve through the virtual markers around a corner.  With 2, corners of
# ragged and much blurred prints are 1 to 2 % more exact and those of small spheres 2 % less, but
# waves of 2.2 checkers lose 40 % of their bends.
DEGREE = 4
# Where these turn by more than this from checker to checker, rad, against what the corners show,
# they follow a ragged edge.
RAGGED_TURN = 0.2


class GridlineBends:
    """How the gridlines of one grid bend at its corners, first as the corners show it.

    corners (rows, cols, 2) px; std (rows, cols) px; pull (rows, cols, 2, 4): as of `SaddlePoints`.
    """

    def __init__(self, corners: Float, std: Float, pull: Float) -> None:
        self._corners = corners
        self._cols = _AxisBends(corners, std, pull)
        self._rows = _AxisBends(_transposed(corners), _transposed(std), _transposed(pull))

    def add_markers(self, corners: Float, rows: Float, cols: Float) -> None:
        """Improve the bends by the curves through the virtual markers.

        corners: as corrected so far; rows (rows, cols-1, n, 2), cols (rows-1, cols, n, 2), px.
        """
        self._cols.add_markers(corners, cols)
        self._rows.add_markers(_transposed(corners), _transposed(rows))

    def corrected(self) -> Float:
        """The corners (rows, cols, 2) px once their edges are expected to bend like this."""
        moved: Float = self._corners + self._cols.shifts() + self._rows.shifts().swapaxes(0, 1)
        return moved


class _AxisBends:
    """The bends of the gridlines along axis 0."""

    def __init__(self, corners: Float, std: Float, pull: Float) -> None:
        self._corners, self._pull = corners, pull
        self._bends = np.empty_like(corners)
        self._noise = _corner_bends(corners, std, self._bends)

    def add_markers(self, corners: Float, markers: Float) -> None:
        n = markers.shape[2]
        if n > 0:
            markers = np.ascontiguousarray(markers)
            _add_markers(corners, markers, _derivatives(n), 1 - self._noise, self._bends)

    def shifts(self) -> Float:
        """By how much the bends move each corner (rows, cols, 2), px."""
        shifts = np.zeros_like(self._corners)
        _add_shifts(self._corners, self._bends, self._pull, shifts)
        return shifts


def _transposed(array: Float) -> Float:
    return np.ascontiguousarray(array.swapaxes(0, 1))


@lru_cache
def _derivatives(n: int) -> Float:
    """Weights (2, 2 n + 1) of the first and half the second derivative, per segment, at a corner.

    Of the n virtual markers before the corner, the corner and the n behind it.
    """
    place = np.arange(-n, n + 1) / (n + 1)
    terms = np.vander(place, min(max(n, 2), DEGREE) + 1, increasing=True)
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


@kernel
def _corner_bends(corners: Float, std: Float, bends: Float) -> float:
    """Set the bends along axis 0 to those that the corners show; which share of them is noise."""
    crests = np.empty_like(corners)
    _set_bends(corners, bends)
    noise = _set_crests(corners, std, bends, crests)
    bends += (SHARPEN + (SMOOTHEN - SHARPEN) * noise) * crests
    return noise


@kernel
def _add_markers(
    corners: Float, markers: Float, derivatives: Float, trust: float, bends: Float
) -> None:
    """Mix into the bends those that virtual markers (a - 1, b, n, 2) along axis 0 show."""
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
def _add_shifts(corners: Float, bends: Float, pull: Float, shifts: Float) -> None:
    """Add what bends along axis 0 move each corner by."""
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
                shifts[i, j, d] += edge[2 + d] * across
