"""Frames torn across: above and below an image row they show different moments or places.

A transfer that breaks off leaves the upper part of one frame above the lower part of another, lost
bytes roll all rows below.  The gridlines then jump along one image row, by whole checkers or by a
part of one, and what lies on one side of it says nothing about the other side.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.tracking.detector import CornerGraph
from cmp_tactile_processing.tracking.nominal_grid import NominalGrid

__all__ = ["continues", "cut_at", "torn_rows"]

Float = NDArray[np.float64]
Whole = NDArray[np.intp]

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
# A gridline that lies along a row has so large a share of the corners on one side within this
# distance, in sides, but at least what detected corners are off by, px.
ALONG, ON_ROW, ON_ROW_PX = 0.4, 0.06, 1.0
# Across such a row gridlines go on where so large a share of the corners beside it has pointers
# across, and groups of neighbouring ones jump by less than this in the mean, as above.
CROSSING, GROUP, LARGEST_JUMP, LARGEST_JUMP_PX = 0.5, 5, 0.08, 0.8
# A corner this near to a tear is of neither part, in sides.
TOO_NEAR = 0.15
# Two numbered parts belong together where corners next to each other moved alike, in sides.
MOVED_ALIKE, NEXT = 0.3, 2


def torn_rows(image: PreparedImage) -> list[int]:
    """The rows of an image below which another picture may begin, each that picture's first row.

    Most frames have none; sharp edges along a row, as of what covers the gel, are among them.
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


def cut_at(
    graph: CornerGraph, rows: list[int], image: PreparedImage, nominal: NominalGrid
) -> tuple[CornerGraph, list[float]]:
    """The graph without pointers across those rows at which gridlines jump, and where these are.

    rows: as `torn_rows` returns them.  The result is in px, between the last row above and the
    first row below.
    """
    side = nominal.side_px
    tears = [
        row - 0.5
        for row in rows
        if _is_torn(graph, row, image, side) and not _is_gridline(graph, row - 0.5, side)
    ]
    if not tears:
        return graph, tears
    y = graph.position[:, 1]
    part = np.searchsorted(tears, y)
    lost = np.abs(y[:, None] - tears).min(axis=1) < TOO_NEAR * side
    other = graph.neighbour
    across = (other >= 0) & ((part[:, None] != part[other]) | lost[:, None] | lost[other])
    return replace(graph, neighbour=np.where(across, -1, other), merged=graph.merged & ~lost), tears


def continues(one: Float, other: Float, nominal: NominalGrid) -> bool:
    """Whether two numbered parts (rows, cols, 2) px, NaN where not known, lie beside each other.

    False, too, where a number is in both or no corner of one is next to one of the other.
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
    return len(distance) > 0 and bool(np.percentile(distance, 80) <= MOVED_ALIKE)


def _is_torn(graph: CornerGraph, row: int, image: PreparedImage, side: float) -> bool:
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


def _is_gridline(graph: CornerGraph, tear: float, side: float) -> bool:
    """Whether a gridline lies along a row and others go on across it.

    Detected corners are drawn to one another across a tear: that gridlines seem to go on shows
    little elsewhere, and nothing is lost where parts that continue each other are numbered one by
    one.
    """
    from_tear = graph.position[:, 1] - tear
    above = np.count_nonzero((from_tear < 0) & (from_tear > -BESIDE * side))
    below = np.count_nonzero((from_tear >= 0) & (from_tear < BESIDE * side))
    on_row = np.count_nonzero(np.abs(from_tear) < max(ON_ROW * side, ON_ROW_PX))
    if on_row < ALONG * max(above, below):
        return False
    jump = _jumps_across(graph, from_tear < 0)
    if len(jump) < CROSSING * min(above, below):
        return False
    limit = max(LARGEST_JUMP * side, LARGEST_JUMP_PX)
    groups = np.array_split(jump, max(len(jump) // GROUP, 1))
    return all(bool(np.linalg.norm(np.median(group, axis=0)) <= limit) for group in groups)


def _jumps_across(graph: CornerGraph, above: NDArray[np.bool_]) -> Float:
    """Of the pointers that lead down across a row: the step less that before and after, (n, 2) px.

    In the order of x; pointers of corners with no other ones along that gridline are left out.
    """
    position, other = graph.position, graph.neighbour
    start, towards = np.nonzero((other >= 0) & above[:, None] & ~above[other])
    end = other[start, towards]
    before, after = other[start, (towards + 2) % 4], other[end, towards]
    steps = np.stack(
        [
            np.where((before >= 0)[:, None], position[start] - position[before], np.nan),
            np.where((after >= 0)[:, None], position[after] - position[end], np.nan),
        ]
    )
    counted = np.isfinite(steps[..., :1])
    usual = np.where(counted, steps, 0.0).sum(axis=0) / np.maximum(counted.sum(axis=0), 1)
    jump = position[end] - position[start] - usual
    chosen = np.flatnonzero(counted.any(axis=0)[:, 0])
    return np.asarray(jump[chosen[np.argsort(position[start[chosen], 0])]])
