"""Views that show the pattern otherwise than described: torn across, mirrored or turned.

A transfer that breaks off leaves the upper part of one frame above the lower part of another, lost
bytes roll all rows below.  The gridlines then jump along one image row, by whole checkers or by a
part of one, and what lies on one side of it says nothing about the other side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.measured import GridFault
from cmp_tactile_processing.tracking.detector import CornerGraph, NominalGrid

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


# A view that is mirrored or turned, distinguished from one that is deformed.

# A deformed grid differs in shape from the nominal one by less than this, in sides, RMS.
LARGEST_DEFORMATION = 0.5
# Another view of the pattern must explain the corners this much better; where it explains them as
# well, within the same factor, only the last frame decides.
BETTER = 0.85
# A part of the grid that is strained can look like a turned part of it, unless it is this large.
TURNED_SHARE = 0.6
# The last frame's corners speak for a place from which they moved less than this, in sides.
LITTLE_MOTION = 0.5
# Views whose nominal grids differ by less than this, in sides, cannot be distinguished.
ALIKE = 0.4
# In a frame that is turned by half, one view may look nearly as the other one: grids that differ
# by less than this, in sides, are the same.
ALIKE_ACROSS = 0.15
# A gel does not turn as a whole by more than this, rad: the largest of hard twists is 0.04.
LARGEST_TURN = 0.1
# Fewer corners have little shape.
FEWEST_CORNERS = 40
QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
MIRROR = np.array([[-1.0, 0.0], [0.0, 1.0]])


class OtherViews:
    """The nominal grid mirrored or turned in the image, numbered as it would then be taken for.

    beside: nominal corners (rows, cols, 2) px of the sensor's other views, which a frame that is
    turned shows in this one's place.
    """

    def __init__(self, nominal: NominalGrid, beside: Sequence[NDArray[np.float64]] = ()) -> None:
        self._nominal = nominal
        self._others: list[tuple[GridFault, NDArray[np.float64]]] = []
        # Those that only turn this view's numbers into another's where they fit clearly better.
        self._beside: list[NDArray[np.float64]] = []
        for turns, mirrored in product(range(4), (False, True)):
            change = np.linalg.matrix_power(QUARTER_TURN, turns)
            change = change @ MIRROR if mirrored else change
            seen = _renumbered(nominal.corners @ change.T, nominal)
            if self._difference(seen) > ALIKE:
                fault = GridFault.MIRRORED if mirrored else GridFault.TURNED
                self._others.append((fault, seen))
            if not mirrored:
                across = [_renumbered(corners @ change.T, nominal) for corners in beside]
                self._beside += [seen for seen in across if self._difference(seen) > ALIKE_ACROSS]
        differences = [self._difference(seen) for seen in self._beside]
        self._least_difference = min([ALIKE, *differences])

    def _difference(self, seen: NDArray[np.float64]) -> float:
        everywhere = np.indices(seen.shape[:2]).reshape(2, -1).T
        return shape_misfit(seen.reshape(-1, 2), everywhere, self._nominal.corners, self._nominal)

    def seen_in(
        self,
        position: NDArray[np.float64],
        number: NDArray[np.intp],
        previous: NDArray[np.float64] | None = None,
    ) -> tuple[GridFault, str]:
        """MIRRORED or TURNED where corners (n, 2) px and their numbers show it, else NONE.

        AMBIGUOUS where a turned view fits the whole grid as well and previous, the last frame's
        corners (rows, cols, 2) px, does not decide.
        """
        if len(position) < FEWEST_CORNERS:
            return GridFault.NONE, ""
        own = shape_misfit(position, number, self._nominal.corners, self._nominal)
        # Views differ by more: none fits nearly as well as one that fits so well.
        if own < self._least_difference * BETTER / (1 + BETTER):
            return GridFault.NONE, ""
        mirrored = turned = np.inf
        if own > LARGEST_DEFORMATION:
            mirrored = self._least(GridFault.MIRRORED, position, number)
        across = np.inf
        if len(position) >= TURNED_SHARE * self._nominal.corners[..., 0].size:
            turned = self._least(GridFault.TURNED, position, number)
            across = min(
                (self._least_misfit(position, number, corners) for corners in self._beside),
                default=float("inf"),
            )
        if mirrored < min(BETTER * own, turned):
            return GridFault.MIRRORED, (
                "the view is a mirror image of the expected one; "
                "check views.<view>.mirror and views.<view>.roi in the sensor's description"
            )
        if min(turned, across) < BETTER * own:
            reason = "the pattern is turned in the image against the sensor's description"
            return GridFault.TURNED, reason
        whole = len(position) == self._nominal.corners[..., 0].size
        if whole and BETTER * turned < own and not self._as_before(position, number, previous):
            return GridFault.AMBIGUOUS, "the pattern fits as well turned in the image"
        return GridFault.NONE, ""

    def _as_before(
        self,
        position: NDArray[np.float64],
        number: NDArray[np.intp],
        previous: NDArray[np.float64] | None,
    ) -> bool:
        if previous is None:
            return False
        apart = np.linalg.norm(position - previous[number[:, 0], number[:, 1]], axis=1)
        apart = apart[np.isfinite(apart)]
        limit = LITTLE_MOTION * self._nominal.side_px
        return len(apart) >= FEWEST_CORNERS and bool(np.median(apart) <= limit)

    def _least(
        self, fault: GridFault, position: NDArray[np.float64], number: NDArray[np.intp]
    ) -> float:
        """The smallest misfit of the corners from the views of that kind."""
        return min(
            (
                self._least_misfit(position, number, corners)
                for kind, corners in self._others
                if kind is fault
            ),
            default=float("inf"),
        )

    def _least_misfit(
        self, position: NDArray[np.float64], number: NDArray[np.intp], corners: NDArray[np.float64]
    ) -> float:
        """Over the places that the set of corners can have on the grid."""
        number = number - number.min(axis=0)
        room = np.array(corners.shape[:2]) - number.max(axis=0)
        return min(
            (
                shape_misfit(position, number + shift, corners, self._nominal)
                for shift in product(range(room[0]), range(room[1]))
            ),
            default=float("inf"),
        )


def turn_of(position: NDArray[np.float64], number: NDArray[np.intp], nominal: NominalGrid) -> float:
    """Angle, rad, by which numbered corners (n, 2) px as a whole are turned from nominal ones."""
    return float(np.angle(np.vdot(*_centred(position, number, nominal.corners)[::-1])))


def shape_misfit(
    position: NDArray[np.float64],
    number: NDArray[np.intp],
    corners: NDArray[np.float64],
    nominal: NominalGrid,
) -> float:
    """RMS distance in sides of numbered corners from a grid's, wherever and however turned it lies.

    `turn_of` says by how much it is turned.
    """
    seen, grid = _centred(position, number, corners)
    product_of_both = abs(np.vdot(grid, seen))
    squared = np.vdot(seen, seen).real + np.vdot(grid, grid).real - 2 * product_of_both
    return float(np.sqrt(max(squared, 0.0) / len(seen)) / nominal.side_px)


def _centred(
    position: NDArray[np.float64], number: NDArray[np.intp], corners: NDArray[np.float64]
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Corners and a grid's of the same numbers, (n,) px each as x + i y about their mean."""
    grid = corners[number[:, 0], number[:, 1]]
    seen, nominal = (points[:, 0] + 1j * points[:, 1] for points in (position, grid))
    return seen - seen.mean(), nominal - nominal.mean()


def _renumbered(corners: NDArray[np.float64], nominal: NominalGrid) -> NDArray[np.float64]:
    """A grid with i and j running as the nominal ones do, as far as its shape allows."""
    rows, cols = nominal.corners.shape[:2]
    candidates = []
    for across in (False, True):
        grid = corners.swapaxes(0, 1) if across else corners
        if grid.shape[:2] == (rows, cols):
            candidates += [grid, grid[::-1], grid[:, ::-1], grid[::-1, ::-1]]
    return max(candidates, key=lambda grid: _alignment(grid, nominal.corners))


def _alignment(grid: NDArray[np.float64], nominal: NDArray[np.float64]) -> float:
    return float(sum((np.diff(grid, axis=d) * np.diff(nominal, axis=d)).sum() for d in (0, 1)))
