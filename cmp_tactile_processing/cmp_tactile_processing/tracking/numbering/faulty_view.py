"""Views that do not show the pattern as described: mirrored, turned, or torn across.

A transfer that breaks off leaves the upper part of one frame above the lower part of another; lost
bytes roll all rows below.  In such a torn view everything jumps alike along one image row, by whole
checkers or by a part of one, and what lies on one side of it says nothing about the other side.
Grey values that change from one row to the next tell where that may be, and are no proof: a
gridline along a row, or the edge of what covers the gel, changes them too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.measured import GridFault
from cmp_tactile_processing.tracking.corners.measured_markers import NEAR_TEAR
from cmp_tactile_processing.tracking.detector import STEPS, CornerGraph, NominalGrid

# A deformed grid differs in shape from the nominal one by less than this, in sides, RMS.
LARGEST_DEFORMATION = 0.5
# Another view of the pattern must explain the corners this much better; where it explains them as
# well, within the same factor, only the last frame decides.
BETTER = 0.85
# A part of the grid that is strained can look like a turned part of it, unless it is this large.
TURNED_SHARE = 0.6
# The last frame's corners speak for a place from which they moved less than this, in sides.
LITTLE_MOTION = 0.5
# Views with nominal grids that differ by less than this, in sides, cannot be distinguished.
MIN_VIEW_DIFFERENCE_SIDES = 0.4
# In a frame that is turned by half, one view may look nearly as the other one: grids that differ
# by less than this, in sides, are the same.
MIN_HALF_TURN_DIFFERENCE_SIDES = 0.15
# A part of a grid also fits another view in some places.  If less than this share of the grid is
# seen, the other view must leave this share of the difference at most.
MIN_WHOLE_SHARE = 0.9
MAX_OTHER_DIFFERENCE_RATIO = 0.5
# A gel does not turn as a whole by more than this, rad: the largest of hard twists is 0.04.
LARGEST_TURN = 0.1
# Fewer corners have little shape.
FEWEST_CORNERS = 40
QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
MIRROR = np.array([[-1.0, 0.0], [0.0, 1.0]])
Float = NDArray[np.float64]
# At a tear the grey values change from one row to the next by at least this share of the contrast.
# A lens spreads the scene over several rows: samples and benchmark reach 0.035.  Twenty gridlines
# that jump by a pixel make 0.044.
MIN_ROW_CHANGE = 0.04
# The change exceeds those between the rows before and after by this share of the contrast, or by
# this share of these changes: a gridline along a row reaches 1.6 times what is around.
MIN_EXCESS_CHANGE = 0.025
MIN_EXCESS_RATIO = 0.65
# A row is tested in stretches of this length that have corners within this distance above and
# below it, in sides: the edge of an object that covers the gel has corners on one side only.
STRETCH_SIDES = 1.5
MAX_CORNER_DISTANCE_SIDES = 1.5
MIN_STRETCHES = 3
# At a tear at least this share of the stretches changes by this share of the contrast.
MIN_CHANGED_SHARE = 0.4
MIN_STRETCH_CHANGE = 0.02
# The change at a row shifts corners nearer than this, in sides; they are not compared.
MIN_COMPARED_DISTANCE_SIDES = 0.4
# Corners up to this far from the row are compared with the nearest one beyond it.
MAX_COMPARED_DISTANCE_SIDES = 1.8
# That one is at most so far away.
MAX_PAIR_DISTANCE_SIDES = 3.0
# Pairs of corners across a row are judged in so many parts (left, middle, right), of which two
# need at least MIN_PAIRS pairs.
ROW_PARTS = 3
MIN_PAIRS = 3
# At a tear each part jumps by at least this.  In 31,000 rows of 600 whole pictures, at rest,
# pressed, dragged and twisted, the smallest jump of the parts was 0.09 sides at most, and 0.046 in
# 433 suspected rows; in torn pictures the lower quarter begins at 0.15.
MIN_JUMP_SIDES = 0.08
MIN_JUMP_PX = 0.8
# A gridline lies along a row if this share of the pointers within a side of it does, within this
# slope.
MIN_ALONG_SHARE = 0.25
MAX_ALONG_SLOPE = 0.15
# Change at a row over the largest at the two rows before and after it: where a gridline lies along
# a row, a lens leaves 1.6 at most; rows that are rolled by lost bytes reach 4.8 to 15.
MAX_LENS_RATIO = 3.0
# Two numbered parts belong together if corners up to MAX_NEIGHBOUR_DISTANCE numbers apart have
# moved alike, within this difference, in sides.
MAX_MOTION_DIFFERENCE_SIDES = 0.3
MAX_NEIGHBOUR_DISTANCE = 2


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
        # Whether a mirror image differs from the expected view in nothing but light and dark.
        self.mirror_exchanges_colours = False
        for turns, mirrored in product(range(4), (False, True)):
            change = np.linalg.matrix_power(QUARTER_TURN, turns)
            change = change @ MIRROR if mirrored else change
            seen, exchanged = _renumbered(nominal.corners @ change.T, nominal)
            if self._difference(seen) > MIN_VIEW_DIFFERENCE_SIDES:
                fault = GridFault.MIRRORED if mirrored else GridFault.TURNED
                self._others.append((fault, seen))
            elif mirrored and exchanged:
                self.mirror_exchanges_colours = True
            if not mirrored:
                across = [_renumbered(corners @ change.T, nominal)[0] for corners in beside]
                self._beside += [
                    seen
                    for seen in across
                    if self._difference(seen) > MIN_HALF_TURN_DIFFERENCE_SIDES
                ]
        differences = [self._difference(seen) for seen in self._beside]
        self._least_difference = min([MIN_VIEW_DIFFERENCE_SIDES, *differences])

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
        share = len(position) / self._nominal.corners[..., 0].size
        mirrored = turned = np.inf
        if own > LARGEST_DEFORMATION:
            mirrored = self._least(GridFault.MIRRORED, position, number)
        across = np.inf
        if share >= TURNED_SHARE:
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
        sure = BETTER if share >= MIN_WHOLE_SHARE else MAX_OTHER_DIFFERENCE_RATIO
        if turned < BETTER * own or across < sure * own:
            reason = "the pattern in the image is turned relative to the sensor's description"
            return GridFault.TURNED, reason
        if share == 1 and BETTER * turned < own and not self._as_before(position, number, previous):
            return GridFault.AMBIGUOUS, "the pattern fits equally well if it is turned in the image"
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


def turned_reason(
    position: NDArray[np.float64],
    number: NDArray[np.intp],
    nominal: NominalGrid,
    largest: float = LARGEST_TURN,
) -> str:
    """What is to be said of corners that are turned by more than a gel turns, else empty."""
    angle = turn_of(position, number, nominal)
    if abs(angle) <= largest:
        return ""
    return turned_by(float(np.degrees(angle)))


def turned_by(degrees: float) -> str:
    """What is to be said of a pattern that is turned by so much."""
    return (
        f"the pattern in the image is turned by {degrees:.0f} degrees relative to the sensor's "
        "description"
    )


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


def _renumbered(
    corners: NDArray[np.float64], nominal: NominalGrid
) -> tuple[NDArray[np.float64], bool]:
    """A grid with i and j running as the nominal ones do, as far as its shape allows.

    And whether its first checker then has the other colour.
    """
    rows, cols = nominal.corners.shape[:2]
    candidates = []
    for across, down, right in product((False, True), repeat=3):
        grid = corners.swapaxes(0, 1) if across else corners
        if grid.shape[:2] == (rows, cols):
            turned = grid[:: -1 if down else 1, :: -1 if right else 1]
            candidates.append((turned, (down * rows + right * cols) % 2 == 1))
    return max(candidates, key=lambda item: _alignment(item[0], nominal.corners))


def _alignment(grid: NDArray[np.float64], nominal: NDArray[np.float64]) -> float:
    return float(sum((np.diff(grid, axis=d) * np.diff(nominal, axis=d)).sum() for d in (0, 1)))


def torn_rows(image: PreparedImage) -> list[int]:
    """The rows of an image below which another picture may begin, each that picture's first row.

    Most frames have none; gridlines and other sharp edges along a row are among them.
    """
    grey = image.grey
    # The change to a row at row + 2, so that there are two before the first and after the last.
    changes = np.zeros(grey.shape[0] + 4)
    difference = cv2.absdiff(grey[1:], grey[:-1])
    changes[3:-2] = cv2.reduce(difference, 1, cv2.REDUCE_SUM, dtype=cv2.CV_32S)[:, 0]
    least = MIN_ROW_CHANGE * image.contrast * grey.shape[1]
    around = np.maximum.reduce([changes[:-4], changes[1:-3], changes[3:-1], changes[4:]])
    outstanding = np.maximum(MIN_EXCESS_CHANGE / MIN_ROW_CHANGE * least, MIN_EXCESS_RATIO * around)
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
    lost = np.abs(y[:, None] - tears).min(axis=1) < NEAR_TEAR * side
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


def is_torn(graph: CornerGraph, tear: float, image: PreparedImage, side: float) -> bool:
    """Whether the gridlines jump at a suspected tear; side: of a checker, px.

    Where too few corners lie beside it to tell, it is one unless a gridline along the row explains
    why the grey values change there, over as many rows as a lens spreads it.
    """
    jump = jumps_at(graph, tear, side)
    if jump is not None:
        return jump
    return _is_sharp(image, round(tear + 0.5)) or not _runs_along(graph, tear, side)


def _is_sharp(image: PreparedImage, row: int) -> bool:
    """Whether grey values change at a row by more than a lens lets them."""
    around = image.grey[row - 3 : row + 3].astype(np.float64)
    changes = np.abs(np.diff(around, axis=0)).sum(axis=1)
    return bool(changes[2] > MAX_LENS_RATIO * changes[[0, 1, 3, 4]].max())


def proven_tears(
    graph: CornerGraph, rows: list[int], image: PreparedImage, side: float
) -> list[float]:
    """Of the tears that `suspected_tears` finds those at which gridlines jump."""
    return [
        tear
        for tear in suspected_tears(graph, rows, image, side)
        if is_torn(graph, tear, image, side)
    ]


def jumps_at(graph: CornerGraph, tear: float, side: float) -> bool | None:
    """Whether the gridlines jump across a row, on the left, in the middle and on the right.

    The lattice of the corners above is carried on to the next ones below: what it misses them by,
    beyond whole checkers, is their jump.  A deformed gel leaves some of that too, but not
    everywhere along a row.  None where too few corners lie on one side to tell.
    """
    start, end, axes = _pairs_across(graph, tear, side)
    parts = min(ROW_PARTS, len(start) // MIN_PAIRS)
    if parts < 2:
        return None
    order = np.argsort(graph.position[start, 0])
    way = (graph.position[end] - graph.position[start])[order]
    steps = np.linalg.solve(axes[order], way[..., None])[..., 0]
    jump = np.abs(steps - np.rint(steps))
    least = min(np.linalg.norm(np.median(p, axis=0)) for p in np.array_split(jump, parts))
    return bool(least >= max(MIN_JUMP_SIDES, MIN_JUMP_PX / side))


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
        for reach in range(1, MAX_NEIGHBOUR_DISTANCE + 1):
            for first, second in ((moved, others_moved), (others_moved, moved)):
                a = np.moveaxis(first, axis, 0)[:-reach]
                b = np.moveaxis(second, axis, 0)[reach:]
                apart.append(np.linalg.norm(b - a, axis=-1).ravel())
    distance = np.concatenate(apart)
    distance = distance[np.isfinite(distance)] / nominal.side_px
    return (
        bool(np.percentile(distance, 80) <= MAX_MOTION_DIFFERENCE_SIDES) if len(distance) else None
    )


def _goes_through(graph: CornerGraph, row: int, image: PreparedImage, side: float) -> bool:
    """Whether the change at a row goes through what lies between the corners above and below."""
    height, width = image.grey.shape
    length = STRETCH_SIDES * side
    stretch = (graph.position[:, 0] / length).astype(np.intp)
    from_tear = graph.position[:, 1] - row + 0.5
    above = stretch[(from_tear < 0) & (from_tear > -MAX_CORNER_DISTANCE_SIDES * side)]
    between = np.intersect1d(
        above, stretch[(from_tear >= 0) & (from_tear < MAX_CORNER_DISTANCE_SIDES * side)]
    )
    if len(between) < MIN_STRETCHES or not 3 <= row < height - 2:
        return False
    changes = np.abs(np.diff(image.grey[row - 3 : row + 3].astype(np.float64), axis=0))
    starts = (np.arange(int(width / length) + 1) * length).astype(np.intp)
    sums = np.add.reduceat(changes, starts[starts < width], axis=1)[:, between]
    least = MIN_STRETCH_CHANGE * image.contrast * length
    changed = sums[2] - sums[[0, 1, 3, 4]].max(axis=0) > least
    return bool(np.count_nonzero(changed) >= MIN_CHANGED_SHARE * len(between))


def _runs_along(graph: CornerGraph, tear: float, side: float) -> bool:
    """Whether a gridline lies along a row."""
    start, towards = np.nonzero(graph.neighbour >= 0)
    near = np.abs(graph.position[start, 1] - tear) < side
    way = graph.position[graph.neighbour[start, towards]] - graph.position[start]
    level = np.abs(way[near, 1]) < MAX_ALONG_SLOPE * np.abs(way[near, 0])
    return bool(np.count_nonzero(level) >= MIN_ALONG_SHARE * max(len(level), 1))


def _pairs_across(
    graph: CornerGraph, tear: float, side: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], Float]:
    """Corners above a row, the next one below of each, and the lattice between them.

    The last has px (n, 2, 2) for a step along i and j, in columns: the mean of what the gridlines
    have beyond either corner.
    """
    position, from_tear = graph.position, graph.position[:, 1] - tear
    other, free = graph.neighbour, np.abs(from_tear) >= MIN_COMPARED_DISTANCE_SIDES * side
    above = from_tear < 0
    same = (other >= 0) & free[other] & (above[other] == above[:, None])
    ahead = np.where(same[..., None], position[other] - position[:, None], np.nan)
    # Towards i + 1 and j + 1, from the pointers there and back.
    both = np.stack([[ahead[:, 2], -ahead[:, 0]], [ahead[:, 1], -ahead[:, 3]]])
    count = np.isfinite(both).sum(axis=1)
    axes = np.where(np.isnan(both), 0.0, both).sum(axis=1) / np.where(count, count, np.nan)
    usable = free & np.isfinite(axes[..., 0]).all(axis=0) & graph.merged
    usable &= np.abs(from_tear) <= MAX_COMPARED_DISTANCE_SIDES * side
    start, ends = np.flatnonzero(usable & above), np.flatnonzero(usable & ~above)
    if not len(start) or not len(ends):
        return start[:0], start[:0], np.zeros((0, 2, 2))
    distance, nearest = cKDTree(position[ends]).query(position[start])
    near = distance <= MAX_PAIR_DISTANCE_SIDES * side
    start, end = start[near], ends[np.asarray(nearest)[near]]
    return start, end, np.moveaxis((axes[:, start] + axes[:, end]) / 2, 0, -1)
