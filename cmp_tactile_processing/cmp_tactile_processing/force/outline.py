"""The outline of a contact: a level of the pressure, followed from cell to cell.

It is linear between the nodes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part

# Pressure on the outline over the contact's mean.  The reconstruction widens a contact, the more
# the narrower it is: under a ball the level is WIDE_LEVEL + NARROW_LEVEL / width^2, the width in
# spacings of the nodes.
WIDE_LEVEL, NARROW_LEVEL = 0.3, 1.1
# Levels over the mean pressure whose areas are compared: the steepness of the pressure is the
# logarithm of the ratio of these areas.
COMPARED_LEVELS = 0.3, 0.8
# Under a ball the steepness is GENTLE_STEEPNESS + NARROW_STEEPNESS / width, at most
# MAX_GENTLE_STEEPNESS.
GENTLE_STEEPNESS = 0.14
NARROW_STEEPNESS = 0.9
MAX_GENTLE_STEEPNESS = 0.53
# Where the pressure ends abruptly, as under a flat punch, it is less, and the level of the outline
# is higher by this times the difference.
LEVEL_PER_STEEPNESS = 5.3

# Even the outline of a single node encloses something.
HIGHEST_LEVEL = 0.6

Array = NDArray[np.float64]


class Rings(NamedTuple):
    """Closed boundaries: counter-clockwise, but of holes clockwise.

    points (n, 2): (col, row), ring after ring, no first point repeated.  ends (rings,): where in
    them each ring ends.
    """

    points: Array
    ends: NDArray[np.intp]


@kernel
def outline(height: Array, mean: float, highest: float) -> tuple[Array, float]:
    """Outer boundary (L, 2) of a contact and its area in cells; (col, row) of the nodes.

    height (rows + 2, cols + 2): its pressure, 0 elsewhere, with a frame of zeros around the grid,
    which lies on the border itself, so that outlines are closed along it.  mean: its mean pressure.
    highest: level above which it would fall apart.
    """
    if not mean > 0:
        return np.empty((0, 2)), 0.0
    top = HIGHEST_LEVEL * height.max()
    low = rings_above(height, min(COMPARED_LEVELS[0] * mean, top))
    high = rings_above(height, min(COMPARED_LEVELS[1] * mean, top))
    wide, slim = _areas(low).sum(), _areas(high).sum()
    # One over the radius of a disc, or over the width of a long strip.
    narrowness = _length(low, height.shape) / (2 * wide)
    of_ball = min(GENTLE_STEEPNESS + NARROW_STEEPNESS * narrowness, MAX_GENTLE_STEEPNESS)
    steepness = max(of_ball - np.log(wide / slim), 0.0)
    level = (WIDE_LEVEL + NARROW_LEVEL * narrowness**2 + LEVEL_PER_STEEPNESS * steepness) * mean
    rings = rings_above(height, max(min(level, highest, top), 0.0))
    areas = _areas(rings)
    outer = np.argmax(areas)
    first = rings.ends[outer - 1] if outer > 0 else 0
    return _distinct(rings.points[first : rings.ends[outer]]), areas.sum()


@kernel_part
def rings_above(height: Array, level: float) -> Rings:
    """Boundaries of what lies above a level, which a frame around the grid does not."""
    rows, cols = height.shape
    follow = np.full(2 * rows * cols, -1, dtype=np.intp)
    for i in range(rows - 1):
        for j in range(cols - 1):
            _link(height, level, i, j, follow)
    points: Array = np.empty((np.count_nonzero(follow >= 0), 2))
    ends = np.empty(len(points), dtype=np.intp)
    count, rings = 0, 0
    for begin in range(len(follow)):
        edge = begin
        while follow[edge] >= 0:
            points[count, 0], points[count, 1] = _crossing(height, level, edge)
            count += 1
            following = follow[edge]
            follow[edge] = -1
            edge = following
        if edge == begin and count > (ends[rings - 1] if rings > 0 else 0):
            ends[rings] = count
            rings += 1
    return Rings(points, ends[:rings].copy())


@kernel_part
def _link(height: Array, level: float, i: int, j: int, follow: NDArray[np.intp]) -> None:
    """Note to which edge the boundary leads from each edge where it enters a cell.

    Edge 2 k goes from node k to the next of its row, edge 2 k + 1 to the next of its column.
    """
    z = height[i, j], height[i, j + 1], height[i + 1, j + 1], height[i + 1, j]
    node, cols = i * height.shape[1] + j, height.shape[1]
    edges = 2 * node, 2 * (node + 1) + 1, 2 * (node + cols), 2 * node + 1
    # Where two corners across are above, the middle decides whether they belong together.
    turn = 1 if 0.25 * (z[0] + z[1] + z[2] + z[3]) > level else 3
    for k in range(4):
        if z[k] > level and not z[(k + 1) % 4] > level:
            leave = (k + turn) % 4
            while z[leave] > level or not z[(leave + 1) % 4] > level:
                leave = (leave + turn) % 4
            follow[edges[k]] = edges[leave]


@kernel_part
def _crossing(height: Array, level: float, edge: int) -> tuple[float, float]:
    """Where the level crosses an edge, (col, row) of the nodes."""
    rows, cols = height.shape
    i, j = edge // 2 // cols, edge // 2 % cols
    k, m = (i + 1, j) if edge % 2 else (i, j + 1)
    share = (level - height[i, j]) / (height[k, m] - height[i, j])
    col, row = j - 1 + share * (m - j), i - 1 + share * (k - i)
    return min(max(col, 0.0), cols - 3.0), min(max(row, 0.0), rows - 3.0)


@kernel_part
def _areas(rings: Rings) -> Array:
    """Areas (rings,) in cells inside of the boundaries, those of holes negative."""
    areas: Array = np.zeros(len(rings.ends))
    begin = 0
    for ring, end in enumerate(rings.ends):
        x0, y0 = rings.points[begin]
        for k in range(begin + 1, end - 1):
            x, y = rings.points[k]
            after_x, after_y = rings.points[k + 1]
            areas[ring] += ((x - x0) * (after_y - y0) - (after_x - x0) * (y - y0)) / 2
        begin = end
    return areas


@kernel_part
def _length(rings: Rings, shape: tuple[int, int]) -> float:
    """Length of boundaries in spacings; along the border of the grid they count as open."""
    total, begin = 0.0, 0
    for end in rings.ends:
        for k in range(begin, end):
            x, y = rings.points[k]
            after_x, after_y = rings.points[k + 1 if k + 1 < end else begin]
            along = x == after_x and x in (0.0, shape[1] - 3.0)
            along |= y == after_y and y in (0.0, shape[0] - 3.0)
            if not along:
                total += np.hypot(after_x - x, after_y - y)
        begin = end
    return total


@kernel_part
def _distinct(ring: Array) -> Array:
    """Without points that are the one before again, as on the border of the grid."""
    found: Array = np.empty(ring.shape)
    count, last = 0, len(ring) - 1
    for k in range(len(ring)):
        if ring[k, 0] != ring[last, 0] or ring[k, 1] != ring[last, 1]:
            found[count] = ring[k]
            count += 1
        last = k
    distinct: Array = found[:count].copy()
    return distinct
