"""Curves along gridlines for the dense surface, compiled: polynomials through nearest points."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["GAP", "MEASURED", "REACH", "UNKNOWN", "fill_corners", "lines_at"]

# What a point on a curve rests on: points next to it, points across a gap, points on one side.
UNKNOWN, MEASURED, GAP, REACH = 0, 1, 2, 3
# Points of a curve's polynomial.
MOST_POINTS = 4


@njit(cache=True, nogil=True)
def _nearest_known(
    known: NDArray[np.uint8], before: NDArray[np.intp], after: NDArray[np.intp]
) -> None:
    """For each point the known one at or before it (else -1), and at or after it (else n)."""
    n = len(known)
    last = -1
    for k in range(n):
        if known[k]:
            last = k
        before[k] = last
    last = n
    for k in range(n - 1, -1, -1):
        if known[k]:
            last = k
        after[k] = last


@njit(cache=True, nogil=True)
def _points_around(
    left: int,
    right: int,
    before: NDArray[np.intp],
    after: NDArray[np.intp],
    points: NDArray[np.intp],
) -> int:
    """The points of the curve between two known ones; returns how many.

    The further ones stand off by half of the gap: noise grows the less across it.
    """
    n = len(before)
    points[0], points[1] = left, right
    count = 2
    step = max(1, (right - left) // 2)
    far_left = before[left - step] if left >= step else -1
    far_right = after[right + step] if right + step < n else n
    if far_left >= 0:
        points[count] = far_left
        count += 1
    if far_right < n:
        points[count] = far_right
        count += 1
    elif far_left >= step and before[far_left - step] >= 0:
        points[count] = before[far_left - step]
        count += 1
    if far_left < 0 and far_right < n - step and after[far_right + step] < n:
        points[count] = after[far_right + step]
        count += 1
    return count


@njit(cache=True, nogil=True)
def _points_beside(
    nearest: int,
    towards: int,
    segment: int,
    found: NDArray[np.intp],
    points: NDArray[np.intp],
) -> int:
    """Points of the curve beyond its end, a segment or more apart; returns how many.

    towards: -1 where they lie before `nearest`, 1 where after it; found: known ones on that side.
    """
    n = len(found)
    points[0] = nearest
    count = 1
    while count < len(points):
        k = points[count - 1] + towards * segment
        if not 0 <= k < n or not 0 <= found[k] < n:
            break
        points[count] = found[k]
        count += 1
    return count


@njit(cache=True, nogil=True)
def _choose_points(  # noqa: PLR0913, PLR0917 - what a curve is made from
    place: float,
    limits: tuple[int, float, int],
    before: NDArray[np.intp],
    after: NDArray[np.intp],
    points: NDArray[np.intp],
    degree: int,
) -> tuple[int, int]:
    """The points of the curve at a place, in steps: how many, and what it rests on.

    limits: points of a segment, how far to go beyond what is known, longest gap; in steps.
    """
    segment, reach, longest = limits
    n = len(before)
    k = min(max(int(np.floor(place)), 0), n - 2)
    left = before[n - 1] if place > n - 1 else before[k]
    right = after[0] if place < 0 else after[k + 1]
    if place > n - 1:
        right = n
    if place < 0:
        left = -1
    if left >= 0 and place == left:
        points[0] = left
        return 1, MEASURED
    if right < n and place == right:
        points[0] = right
        return 1, MEASURED
    within = 0 <= place <= n - 1
    if within and left >= 0 and right < n and right - left <= longest:
        count = _points_around(left, right, before, after, points)
        return count, MEASURED if right - left <= segment else GAP
    off_left = place - left if left >= 0 else np.inf
    off_right = right - place if right < n else np.inf
    if min(off_left, off_right) > reach:
        return 0, UNKNOWN
    if off_left <= off_right:
        return _points_beside(left, -1, segment, before, points[: degree + 1]), REACH
    return _points_beside(right, 1, segment, after, points[: degree + 1]), REACH


@njit(cache=True, nogil=True)
def lines_at(  # noqa: PLR0913, PLR0917 - what a curve is made from
    values: NDArray[np.float64],
    known: NDArray[np.uint8],
    places: NDArray[np.float64],
    limits: tuple[int, float, int],
    degree: int,
    out: NDArray[np.float64],
    rests_on: NDArray[np.uint8],
) -> None:
    """Points (lines, places, 3) of curves through the known ones of values (lines, n, 3).

    places: along the lines, in steps between their points.  limits: points of a segment, how far
    to go beyond known points, longest gap, in steps.  degree: of the polynomial beyond them.
    """
    n = values.shape[1]
    before, after = np.empty(n, np.intp), np.empty(n, np.intp)
    points, weights = (
        np.zeros((len(places), MOST_POINTS), np.intp),
        np.empty((len(places), MOST_POINTS)),
    )
    state = np.empty(len(places), np.uint8)
    # Lines without a gap, which are most, have their points and weights in common.
    in_common = False
    for line in range(len(values)):
        whole = known[line].all()
        if not (whole and in_common):
            _nearest_known(known[line], before, after)
            for m in range(len(places)):
                count, state[m] = _choose_points(
                    places[m], limits, before, after, points[m], degree
                )
                _set_weights(places[m], points[m], count, weights[m])
            in_common = whole
        for m in range(len(places)):
            rests_on[line, m] = state[m]
            if state[m] == UNKNOWN:
                out[line, m] = np.nan
                continue
            for d in range(3):
                total = 0.0
                for a in range(MOST_POINTS):
                    if weights[m, a] != 0.0:
                        total += weights[m, a] * values[line, points[m, a], d]
                out[line, m, d] = total


@njit(cache=True, nogil=True)
def _set_weights(
    place: float, points: NDArray[np.intp], count: int, weights: NDArray[np.float64]
) -> None:
    """Weights of the polynomial through the first points of these; 0 for the others."""
    for a in range(MOST_POINTS):
        weights[a] = 1.0 if a < count else 0.0
        for b in range(count):
            if a != b:
                weights[a] *= (place - points[b]) / (points[a] - points[b]) if a < count else 0.0


@njit(cache=True, nogil=True)
def fill_corners(
    rows: tuple[NDArray[np.float64], NDArray[np.uint8]],
    cols: tuple[NDArray[np.float64], NDArray[np.uint8]],
    corners: NDArray[np.float64],
    status: NDArray[np.uint8],
) -> None:
    """Missing corners, in place: the mean of both curves that bridge them; status becomes GAP.

    rows, cols: points at the corners of the curves along rows, (rows, cols, 3), and along columns,
    (cols, rows, 3), and what they rest on.
    """
    for i in range(len(corners)):
        for j in range(corners.shape[1]):
            if status[i, j]:
                continue
            along_row, along_col = rows[1][i, j] != UNKNOWN, cols[1][j, i] != UNKNOWN
            if not (along_row or along_col):
                continue
            share = 0.5 if along_row and along_col else (1.0 if along_row else 0.0)
            for d in range(3):
                total = 0.0
                if along_row:
                    total += share * rows[0][i, j, d]
                if along_col:
                    total += (1 - share) * cols[0][j, i, d]
                corners[i, j, d] = total
            status[i, j] = GAP
