"""Curves along gridlines and patches between them for the dense surface, compiled.

A curve is a polynomial through the nearest known points of its gridline.  A cell is the Coons patch
of the four curves around it, which holds them all and errs by the fourth power of the pitch.
Where something is narrower than a checker that patch rings: it adds up both directions.  There it
is held near to the polynomials across four rows and across four columns, which ring much less.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

# What a point on a curve rests on: points next to it, points across a gap, points on one side.
UNKNOWN, MEASURED, GAP, REACH = 0, 1, 2, 3
# Points of a curve's polynomial.
MOST_POINTS = 4

# A node so near to a gridline, in pitches, lies on it.
ON_LINE = 1e-6
# A patch may leave the polynomials across gridlines by this share of how far these leave straight
# lines: a smooth field needs the less of it the finer the pitch is.
FREEDOM = 0.25


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


@njit(cache=True, nogil=True)
def _cell_of(place: float, count: int, cell: NDArray[np.intp], weight: NDArray[np.float64]) -> int:
    """The gridlines on both sides of a place and their weights; how many: one on and beyond it."""
    k = min(max(int(np.floor(place + ON_LINE)), 0), count - 1)
    if place - k <= ON_LINE or k == count - 1:
        cell[0], weight[0] = k, 1.0
        return 1
    cell[0], cell[1] = k, k + 1
    weight[1] = place - k
    weight[0] = 1 - weight[1]
    return 2


@njit(cache=True, nogil=True)
def _keep_known(
    lines: NDArray[np.intp],
    weight: NDArray[np.float64],
    count: int,
    known: tuple[bool, bool],
    off: tuple[float, float, float],
) -> int:
    """Leave out unknown gridlines; one alone serves as far as `off`: distances and their limit."""
    if count == 1:
        return 1 if known[0] else 0
    if known[0] and known[1]:
        return 2
    if known[0] and off[0] <= off[2]:
        weight[0] = 1.0
        return 1
    if known[1] and off[1] <= off[2]:
        lines[0], weight[0] = lines[1], 1.0
        return 1
    return 0


@njit(cache=True, nogil=True)
def patches_at(  # noqa: PLR0913, PLR0917 - what a patch is made from
    rows: tuple[NDArray[np.float64], NDArray[np.uint8]],
    cols: tuple[NDArray[np.float64], NDArray[np.uint8]],
    corners: tuple[NDArray[np.float64], NDArray[np.uint8]],
    places: tuple[NDArray[np.float64], NDArray[np.float64], float],
    out: NDArray[np.float64],
    status: NDArray[np.uint8],
) -> None:
    """Points (ny, nx, 3) of the patches, and what they rest on.

    rows: points of the curves along rows at the nodes' columns, (rows, nx, 3), and what they rest
    on; cols: (cols, ny, 3).  corners (rows, cols, 3) with status.  places: fractional rows (ny,)
    and columns (nx,) of the nodes; how far to go beyond a gridline, in pitches.
    """
    ny, nx, n_cols = len(places[0]), len(places[1]), corners[0].shape[1]
    i, wi, across_i = np.empty(2, np.intp), np.empty(2), np.empty((2, 4))
    j, wj, across_j = np.empty((nx, 2), np.intp), np.empty((nx, 2)), np.empty((nx, 2, 4))
    first_j = np.empty(nx, np.intp)
    for x in range(nx):
        first_j[x] = _across(places[1][x], n_cols, across_j[x])
        if _cell_of(places[1][x], n_cols, j[x], wj[x]) == 1:
            j[x, 1], wj[x, 1] = j[x, 0], 0.0
    off_rows, rests_on = np.empty((n_cols, 3)), np.empty(n_cols, np.uint8)
    by_rows, rows_known = np.empty((nx, 6)), np.empty(nx, np.bool_)
    on_cols, cols_known = np.empty((n_cols, 3)), np.empty(n_cols, np.bool_)
    for y in range(ny):
        if _cell_of(places[0][y], len(corners[0]), i, wi) == 1:
            i[1], wi[1] = i[0], 0.0
        _cols_off_rows(cols, corners, y, (i, wi), off_rows, rests_on)
        upper, lower = rows[0][i[0]], rows[0][i[1]]
        on_upper, on_lower = rows[1][i[0]], rows[1][i[1]]
        for x in range(nx):
            left, right = j[x, 0], j[x, 1]
            if on_upper[x] and on_lower[x] and rests_on[left] and rests_on[right]:
                for d in range(3):
                    along = wi[0] * upper[x, d] + wi[1] * lower[x, d]
                    across = wj[x, 0] * off_rows[left, d] + wj[x, 1] * off_rows[right, d]
                    out[y, x, d] = along + across
                status[y, x] = max(on_upper[x], on_lower[x], rests_on[left], rests_on[right])
            else:
                place = places[0][y], places[1][x], places[2]
                status[y, x] = _patch_in_part(rows, cols, corners, (y, x), place, out)
        if wi[1] > 0:
            first_i = _across(places[0][y], len(corners[0]), across_i)
            _across_rows(rows, first_i, across_i, by_rows, rows_known)
            _cols_around(cols, y, on_cols, cols_known)
            around = first_j, across_j, wj
            on_rows, of_cols = (by_rows, rows_known), (on_cols, cols_known)
            _hold(on_rows, of_cols, around, wi[0] * wi[1], out[y])


@njit(cache=True, nogil=True)
def _across(place: float, count: int, weights: NDArray[np.float64]) -> int:
    """Weights (2, 4) of four gridlines, of which the first is returned.

    They make the polynomial across them, and how far it leaves the straight line between the two
    around the place.
    """
    k = min(max(int(np.floor(place)), 0), count - 2)
    first = min(max(k - 1, 0), count - 4)
    for a in range(4):
        weights[0, a] = 1.0
        for b in range(4):
            if a != b:
                weights[0, a] *= (place - first - b) / (a - b)
        weights[1, a] = weights[0, a]
    weights[1, k - first] -= k + 1 - place
    weights[1, k + 1 - first] -= place - k
    return first


@njit(cache=True, nogil=True)
def _across_rows(
    rows: tuple[NDArray[np.float64], NDArray[np.uint8]],
    first: int,
    weights: NDArray[np.float64],
    found: NDArray[np.float64],
    known: NDArray[np.bool_],
) -> None:
    """The polynomial across four rows (nx, :3); how far it leaves the straight line (nx, 3:)."""
    known[:] = True
    found[:] = 0.0
    for k in range(4):
        values, rests_on = rows[0][first + k], rows[1][first + k]
        for x in range(len(known)):
            known[x] &= rests_on[x] != UNKNOWN
            for d in range(3):
                found[x, d] += weights[0, k] * values[x, d]
                found[x, 3 + d] += weights[1, k] * values[x, d]


@njit(cache=True, nogil=True)
def _cols_around(
    cols: tuple[NDArray[np.float64], NDArray[np.uint8]],
    y: int,
    found: NDArray[np.float64],
    known: NDArray[np.bool_],
) -> None:
    """Points on the columns (cols, 3) at a node's height; from which on four of them are known."""
    n = len(known)
    for k in range(n):
        known[k] = k + 3 < n
        for m in range(k, min(k + 4, n)):
            known[k] &= cols[1][m, y] != UNKNOWN
        for d in range(3):
            found[k, d] = cols[0][k, y, d]


@njit(cache=True, nogil=True)
def _hold(
    on_rows: tuple[NDArray[np.float64], NDArray[np.bool_]],
    on_cols: tuple[NDArray[np.float64], NDArray[np.bool_]],
    around: tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]],
    off_rows: float,
    out: NDArray[np.float64],
) -> None:
    """Hold a line of nodes (nx, 3), in place, near to the polynomials across rows and columns.

    Of the two that of the nearer gridlines counts the more.  around: first of four columns, their
    weights, and those of the two around a node.
    """
    first, across, weight = around
    for x in range(len(out)):
        off_cols, j = weight[x, 0] * weight[x, 1], first[x]
        if off_cols == 0 or not on_rows[1][x] or not on_cols[1][j]:
            continue
        share = off_cols * off_cols / (off_rows * off_rows + off_cols * off_cols)
        for d in range(3):
            by_cols, bend = 0.0, 0.0
            for k in range(4):
                by_cols += across[x, 0, k] * on_cols[0][j + k, d]
                bend += across[x, 1, k] * on_cols[0][j + k, d]
            middle = share * on_rows[0][x, d] + (1 - share) * by_cols
            most = FREEDOM * (abs(on_rows[0][x, 3 + d]) + abs(bend))
            out[x, d] = min(max(out[x, d], middle - most), middle + most)


@njit(cache=True, nogil=True)
def _cols_off_rows(  # noqa: PLR0913, PLR0917 - what a patch is made from
    cols: tuple[NDArray[np.float64], NDArray[np.uint8]],
    corners: tuple[NDArray[np.float64], NDArray[np.uint8]],
    y: int,
    rows: tuple[NDArray[np.intp], NDArray[np.float64]],
    off_rows: NDArray[np.float64],
    rests_on: NDArray[np.uint8],
) -> None:
    """How far each column's curve lies off the line between its corners on two rows, (cols, 3).

    rests_on (cols,): the least of what it rests on, 0 where the curve or a corner is unknown.
    """
    (upper, lower), weight = rows[0], rows[1]
    for k in range(len(off_rows)):
        first, second, state = corners[1][upper, k], corners[1][lower, k], cols[1][k, y]
        rests_on[k] = max(state, first, second) if first and second and state else UNKNOWN
        for d in range(3):
            between = weight[0] * corners[0][upper, k, d] + weight[1] * corners[0][lower, k, d]
            off_rows[k, d] = cols[0][k, y, d] - between


@njit(cache=True, nogil=True)
def _patch_in_part(  # noqa: PLR0913, PLR0917 - what a patch is made from
    rows: tuple[NDArray[np.float64], NDArray[np.uint8]],
    cols: tuple[NDArray[np.float64], NDArray[np.uint8]],
    corners: tuple[NDArray[np.float64], NDArray[np.uint8]],
    node: tuple[int, int],
    place: tuple[float, float, float],
    out: NDArray[np.float64],
) -> int:
    """The node where not all of its cell is known: from those of its gridlines that are near."""
    y, x = node
    reach = place[2]
    i, j = np.empty(2, np.intp), np.empty(2, np.intp)
    wi, wj = np.empty(2), np.empty(2)
    n_i = _cell_of(place[0], len(corners[0]), i, wi)
    n_j = _cell_of(place[1], corners[0].shape[1], j, wj)
    n_i = _rows_used(i, wi, n_i, rows[1][:, x], (place[0], reach))
    n_j = _cols_used(j, wj, n_j, cols[1][:, y], (place[1], reach), i, n_i, corners[1])
    if n_i == 0 or n_j == 0:
        out[y, x] = np.nan
        return UNKNOWN
    for d in range(3):
        total = 0.0
        for a in range(n_i):
            total += wi[a] * rows[0][i[a], x, d]
        for b in range(n_j):
            total += wj[b] * cols[0][j[b], y, d]
            for a in range(n_i):
                total -= wi[a] * wj[b] * corners[0][i[a], j[b], d]
        out[y, x, d] = total
    return REACH


@njit(cache=True, nogil=True)
def _rows_used(
    i: NDArray[np.intp],
    wi: NDArray[np.float64],
    count: int,
    rests_on: NDArray[np.uint8],
    place: tuple[float, float],
) -> int:
    """How many of the rows around a node are known there, moved to the front."""
    known = rests_on[i[0]] > 0, count > 1 and rests_on[i[1]] > 0
    return _keep_known(i, wi, count, known, (place[0] - i[0], i[0] + 1 - place[0], place[1]))


@njit(cache=True, nogil=True)
def _cols_used(  # noqa: PLR0913, PLR0917 - two directions that are not alike
    j: NDArray[np.intp],
    wj: NDArray[np.float64],
    count: int,
    rests_on: NDArray[np.uint8],
    place: tuple[float, float],
    i: NDArray[np.intp],
    rows_used: int,
    status: NDArray[np.uint8],
) -> int:
    """The same of the columns, of which the corners on the rows used are known, too."""
    first, second = rests_on[j[0]] > 0, count > 1 and rests_on[j[1]] > 0
    for a in range(rows_used):
        first = first and status[i[a], j[0]] > 0
        second = second and count > 1 and status[i[a], j[1]] > 0
    return _keep_known(
        j, wj, count, (first, second), (place[0] - j[0], j[0] + 1 - place[0], place[1])
    )
