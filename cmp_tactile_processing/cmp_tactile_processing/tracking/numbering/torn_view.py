"""Views that are torn across: parts of two pictures, one above the other.

A transfer that breaks off leaves the upper part of one frame above the lower part of another, lost
bytes roll all rows below.  Everything then jumps alike along one image row, by whole checkers or by
a part of one, and what lies on one side of it says nothing about the other side.  Grey values that
change from one row to the next tell where that may be, and are no proof: a gridline along a row,
or the edge of what covers the gel, changes them too.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.tracking.detector import STEPS, CornerGraph, NominalGrid

Float = NDArray[np.float64]
# The grey values change from one row to the next by so much more than from the two rows before and
# the two after, as a share of the contrast; or by less, if that is much of what they change there.
# A lens spreads what lies in the scene over several rows: samples and benchmark reach 0.035, and
# 1.6 times what is around, where a gridline lies along a row.  Twenty gridlines that jump by a
# pixel make 0.044.
LEAST_CHANGE, LEAST_OUTSTANDING, OUTSTANDING = 0.04, 0.025, 0.65
# In stretches of a row of this length in which corners lie above and below it within this
# distance, in sides, of which there are so many at least, so large a share changes by so much: an
# edge of what covers the gel has corners on one side alone.
STRETCH, BESIDE, FEWEST_STRETCHES, CHANGED, LEAST_LOCAL = 1.5, 1.5, 3, 0.4, 0.02
# Corners nearer to a row than the first distance are drawn to those beyond it; those within the
# second are compared with the nearest one beyond the row, no farther than the third.  In sides.
DRAWN, COMPARED, APART = 0.4, 1.8, 3.0
# Pairs of corners on the left, in the middle and on the right of a row, of which two need so many;
# where it is torn each of these jumps by so much at least, in sides and px.  In 31,000 rows of 600
# whole pictures, at rest, pressed, dragged and twisted, the least of them was 0.09 sides at most,
# and 0.046 in 433 suspected ones; in torn ones the lower quarter begins at 0.15.
PARTS, FEWEST_PAIRS, LEAST_JUMP, LEAST_JUMP_PX = 3, 3, 0.08, 0.8
# Where a gridline lies along a row, this share of the pointers within a side of it does, to within
# this slope.
ALONG, LEVEL = 0.25, 0.15
# A corner this near to a tear is of neither part, in sides.
TOO_NEAR = 0.15
# Two numbered parts belong together where corners next to each other moved alike, in sides.
MOVED_ALIKE, NEXT = 0.3, 2


def torn_rows(image: PreparedImage) -> list[int]:
    """The rows of an image below which another picture may begin, each that picture's first row.

    Most frames have none; gridlines and other sharp edges along a row are among them.
    """
    grey = image.grey
    # The change to a row at row + 2, so that there are two before the first and after the last.
    changes = np.zeros(grey.shape[0] + 4)
    difference = cv2.absdiff(grey[1:], grey[:-1])
    changes[3:-2] = cv2.reduce(difference, 1, cv2.REDUCE_SUM, dtype=cv2.CV_32S)[:, 0]
    least = LEAST_CHANGE * image.contrast * grey.shape[1]
    around = np.maximum.reduce([changes[:-4], changes[1:-3], changes[3:-1], changes[4:]])
    outstanding = np.maximum(LEAST_OUTSTANDING / LEAST_CHANGE * least, OUTSTANDING * around)
    found = changes[2:-2] - around > np.minimum(least, outstanding)
    return [int(row) for row in np.flatnonzero(found)]


def suspected_tears(
    graph: CornerGraph, rows: list[int], image: PreparedImage, side: float
) -> list[float]:
    """Where rows of `torn_rows` go through the pattern, px: between two rows.

    side: of a checker, px.
    """
    return [row - 0.5 for row in rows if _goes_through(graph, row, image, side)]


def cut_at(graph: CornerGraph, tears: list[float], side: float) -> CornerGraph:
    """The graph without pointers across these rows, px."""
    y = graph.position[:, 1]
    part = np.searchsorted(tears, y)
    lost = np.abs(y[:, None] - tears).min(axis=1) < TOO_NEAR * side
    other = graph.neighbour
    across = (other >= 0) & ((part[:, None] != part[other]) | lost[:, None] | lost[other])
    return replace(graph, neighbour=np.where(across, -1, other), merged=graph.merged & ~lost)


def lattice_graph(corners: Float) -> CornerGraph:
    """Numbered corners (rows, cols, 2) px, NaN where missing, as a graph; all count as even."""
    known = np.isfinite(corners[..., 0])
    index = np.full((known.shape[0] + 2, known.shape[1] + 2), -1, dtype=np.intp)
    index[1:-1, 1:-1][known] = np.arange(np.count_nonzero(known))
    rows, cols = known.shape
    neighbour = [index[1 + i : 1 + i + rows, 1 + j : 1 + j + cols][known] for i, j in STEPS]
    merged = np.ones(np.count_nonzero(known), dtype=np.bool_)
    return CornerGraph(corners[known], merged, merged, np.stack(neighbour, axis=-1))


def is_torn(graph: CornerGraph, tear: float, side: float) -> bool:
    """Whether the gridlines jump at a suspected tear; side: of a checker, px.

    Where too few corners lie beside it to tell, it is one unless a gridline along the row explains
    why the grey values change there.
    """
    jump = jumps_at(graph, tear, side)
    return not _runs_along(graph, tear, side) if jump is None else jump


def proven_tears(
    graph: CornerGraph, rows: list[int], image: PreparedImage, side: float
) -> list[float]:
    """Of the tears that `suspected_tears` finds those at which gridlines jump."""
    return [
        tear for tear in suspected_tears(graph, rows, image, side) if is_torn(graph, tear, side)
    ]


def jumps_at(graph: CornerGraph, tear: float, side: float) -> bool | None:
    """Whether the gridlines jump across a row, on the left, in the middle and on the right.

    The lattice of the corners above is carried on to the next ones below: what it misses them by,
    beyond whole checkers, is their jump.  A deformed gel leaves some of that too, but not
    everywhere along a row.  None where too few corners lie on one side to tell.
    """
    start, end, axes = _pairs_across(graph, tear, side)
    parts = min(PARTS, len(start) // FEWEST_PAIRS)
    if parts < 2:
        return None
    order = np.argsort(graph.position[start, 0])
    way = (graph.position[end] - graph.position[start])[order]
    steps = np.linalg.solve(axes[order], way[..., None])[..., 0]
    jump = np.abs(steps - np.rint(steps))
    least = min(np.linalg.norm(np.median(p, axis=0)) for p in np.array_split(jump, parts))
    return bool(least >= max(LEAST_JUMP, LEAST_JUMP_PX / side))


def continues(one: Float, other: Float, nominal: NominalGrid) -> bool | None:
    """Whether two numbered parts (rows, cols, 2) px, NaN where not known, lie beside each other.

    False, too, where a number is in both; None where no corner of one is next to one of the other.
    """
    known, others = np.isfinite(one[..., 0]), np.isfinite(other[..., 0])
    if (known & others).any():
        return False
    moved, others_moved = one - nominal.corners, other - nominal.corners
    apart = []
    for axis in (0, 1):
        for reach in range(1, NEXT + 1):
            for first, second in ((moved, others_moved), (others_moved, moved)):
                a = np.moveaxis(first, axis, 0)[:-reach]
                b = np.moveaxis(second, axis, 0)[reach:]
                apart.append(np.linalg.norm(b - a, axis=-1).ravel())
    distance = np.concatenate(apart)
    distance = distance[np.isfinite(distance)] / nominal.side_px
    return bool(np.percentile(distance, 80) <= MOVED_ALIKE) if len(distance) else None


def _goes_through(graph: CornerGraph, row: int, image: PreparedImage, side: float) -> bool:
    """Whether the change at a row goes through what lies between the corners above and below."""
    height, width = image.grey.shape
    length = STRETCH * side
    stretch = (graph.position[:, 0] / length).astype(np.intp)
    from_tear = graph.position[:, 1] - row + 0.5
    above = stretch[(from_tear < 0) & (from_tear > -BESIDE * side)]
    between = np.intersect1d(above, stretch[(from_tear >= 0) & (from_tear < BESIDE * side)])
    if len(between) < FEWEST_STRETCHES or not 3 <= row < height - 2:
        return False
    changes = np.abs(np.diff(image.grey[row - 3 : row + 3].astype(np.float64), axis=0))
    starts = (np.arange(int(width / length) + 1) * length).astype(np.intp)
    sums = np.add.reduceat(changes, starts[starts < width], axis=1)[:, between]
    least = LEAST_LOCAL * image.contrast * length
    changed = sums[2] - sums[[0, 1, 3, 4]].max(axis=0) > least
    return bool(np.count_nonzero(changed) >= CHANGED * len(between))


def _runs_along(graph: CornerGraph, tear: float, side: float) -> bool:
    """Whether a gridline lies along a row."""
    start, towards = np.nonzero(graph.neighbour >= 0)
    near = np.abs(graph.position[start, 1] - tear) < side
    way = graph.position[graph.neighbour[start, towards]] - graph.position[start]
    level = np.abs(way[near, 1]) < LEVEL * np.abs(way[near, 0])
    return bool(np.count_nonzero(level) >= ALONG * max(len(level), 1))


def _pairs_across(
    graph: CornerGraph, tear: float, side: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], Float]:
    """Corners above a row, the next one below of each, and the lattice between them.

    The last has px (n, 2, 2) for a step along i and j, in columns: the mean of what the gridlines
    have beyond either corner.
    """
    position, from_tear = graph.position, graph.position[:, 1] - tear
    other, free = graph.neighbour, np.abs(from_tear) >= DRAWN * side
    above = from_tear < 0
    same = (other >= 0) & free[other] & (above[other] == above[:, None])
    ahead = np.where(same[..., None], position[other] - position[:, None], np.nan)
    # Towards i + 1 and j + 1, from the pointers there and back.
    both = np.stack([[ahead[:, 2], -ahead[:, 0]], [ahead[:, 1], -ahead[:, 3]]])
    count = np.isfinite(both).sum(axis=1)
    axes = np.where(np.isnan(both), 0.0, both).sum(axis=1) / np.where(count, count, np.nan)
    usable = free & np.isfinite(axes[..., 0]).all(axis=0) & graph.merged
    usable &= np.abs(from_tear) <= COMPARED * side
    start, ends = np.flatnonzero(usable & above), np.flatnonzero(usable & ~above)
    if not len(start) or not len(ends):
        return start[:0], start[:0], np.zeros((0, 2, 2))
    distance, nearest = cKDTree(position[ends]).query(position[start])
    near = distance <= APART * side
    start, end = start[near], ends[np.asarray(nearest)[near]]
    return start, end, np.moveaxis((axes[:, start] + axes[:, end]) / 2, 0, -1)
