"""Numbers the corners of a view: right, or missing with a reason.

Rows or columns that rest on one border alone may be wrong: their confidence is 0.5 at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.measured import GridFault
from cmp_tactile_processing.sensor.parts import Pattern
from cmp_tactile_processing.tracking.detector import (
    Component,
    CornerGraph,
    NominalAxes,
    NominalGrid,
)
from cmp_tactile_processing.tracking.numbering.coded_view import CodedView
from cmp_tactile_processing.tracking.numbering.component_placement import (
    FEWEST_CORNERS,
    Anchor,
    ComponentPlacement,
    ConnectedCorners,
    without_blurred,
)
from cmp_tactile_processing.tracking.numbering.faulty_view import (
    LARGEST_TURN,
    TURNED_SHARE,
    OtherViews,
    continues,
    cut_at,
    is_torn,
    suspected_tears,
    turned_reason,
)
from cmp_tactile_processing.tracking.numbering.joining import drop_loose_corners, in_order, joined
from cmp_tactile_processing.tracking.numbering.result import (
    JOINED_CONFIDENCE,
    OTHER_PATTERN,
    Numbering,
    not_seen,
)

# A component that is to be anchored by itself has this share of the corners at least.
SMALLEST_ANCHORED = 0.1
# On a cluttered image without pattern corners connect by chance: up to this share of those.
BY_CHANCE = 0.5
# Checkers that differ by more than this from those of the pattern, in sides, are another one's.
OTHER_STEP = 0.15
# Faults of the description, which need more than a piece of the pattern.
OF_THE_DESCRIPTION = {
    GridFault.OTHER_SIZE,
    GridFault.OTHER_COLOURS,
    GridFault.MIRRORED,
    GridFault.TURNED,
}
# A part of the grid turns with the gel by less than this, rad, where it is smaller than a share
# of the whole; of the whole see `faulty_view.py`.
LARGEST_TURN_OF_PART = 0.25
# Factors of the confidence: for each side where the end of the pattern was not seen, and for
# corners far from the nominal projection.
UNSEEN_SIDE_CONFIDENCE = 0.95
FAR_FROM_NOMINAL_CONFIDENCE = 0.9
# And where rows or columns rest on one border alone, the other one out of sight: something along a
# gridline that is as bright as the margin looks the same.
ONE_BORDER = 0.5


COLOURS_OF_A_MIRROR_IMAGE = (
    "dark and light checkers are exchanged, as in a mirror image; check views.<view>.mirror first: "
    "only if it is right, the pattern is turned by half or pattern.corner_checker is wrong"
)


class GridNumbering:
    """Numbers the corners that a detector found in one view; keeps its buffers.

    nominal: in pixels of the prepared image; dark_first: whether the checker outside corner (0, 0)
    is a dark one; beside: nominal corners (rows, cols, 2) px of the sensor's other views; coded:
    the pattern, where it has a code; axes: where corners may lie, default those of `nominal`.
    """

    def __init__(
        self,
        nominal: NominalGrid,
        dark_first: bool,
        beside: Sequence[NDArray[np.float64]] = (),
        coded: Pattern | None = None,
        axes: NominalAxes | None = None,
    ) -> None:
        self._nominal = nominal
        self._dark_first = dark_first
        self._connected = ConnectedCorners(axes or NominalAxes(nominal))
        self._anchor = ComponentPlacement(nominal, dark_first)
        self._others = OtherViews(nominal, beside)
        self._code = CodedView(nominal, self._connected.axes, coded) if coded else None

    def number(
        self,
        graph: CornerGraph,
        image: PreparedImage,
        previous: NDArray[np.float64] | None = None,
        torn: list[int] | None = None,
    ) -> Numbering:
        """Numbered corners of a graph, all in pixels of the prepared image.

        previous: (rows, cols, 2) px, the last frame's corners, NaN where they were missing.
        torn: what `torn_rows` finds in the image.

        Corners are numbered by the gridlines that connect them, each connected set is anchored by
        itself or by anchored ones; see `ComponentPlacement` and `joined`.  Where the gridlines jump
        across a row, or are not complete and may do so, each part is numbered by itself; of parts
        that do not continue each other only the largest is kept.
        """
        tears = suspected_tears(graph, torn or [], image, self._nominal.side_px)
        jumps = [tear for tear in tears if is_torn(graph, tear, image, self._nominal.side_px)]
        if jumps:
            parts = self._parts_of(graph, jumps, image, previous, proven=True)
            graph = cut_at(graph, jumps, self._nominal.side_px)
            return parts or self._whole(graph, image, previous)
        whole = self._whole(graph, image, previous)
        if not tears or whole.fault is GridFault.NONE:
            return whole
        return self._parts_of(graph, tears, image, previous, proven=False) or whole

    def _whole(
        self, graph: CornerGraph, image: PreparedImage, previous: NDArray[np.float64] | None
    ) -> Numbering:
        """A graph without regard to tears."""
        components, reason = self._components(graph, image)
        if components:
            return self._numbered(components, image, previous)
        if reason:
            return self._missing(GridFault.NO_CONTRAST, reason)
        return self._missing(GridFault.NO_PATTERN, "no checker pattern seen")

    def _components(self, graph: CornerGraph, image: PreparedImage) -> tuple[list[Component], str]:
        """Sets of connected corners, and why some of them are not to be believed.

        Dots are read first: they show themselves whether light and dark can be trusted.
        """
        if self._code is not None:
            return self._connected.all_components(graph), ""
        return self._connected.components(graph, image)

    def _parts_of(
        self,
        graph: CornerGraph,
        tears: list[float],
        image: PreparedImage,
        previous: NDArray[np.float64] | None,
        *,
        proven: bool,
    ) -> Numbering | None:
        """The largest part of an image that is cut at rows; None where its parts are one.

        proven: gridlines jump there; without that, parts are one unless they contradict each other.
        """
        components, _ = self._components(cut_at(graph, tears, self._nominal.side_px), image)
        bounds = [-np.inf, *tears, np.inf]
        parts: list[list[Component]] = [[] for _ in bounds[1:]]
        for component in components:
            parts[int(np.searchsorted(tears, component.position[0, 1]))].append(component)
        found = [
            replace(self._numbered(part, image, previous), between=(above, below))
            for part, above, below in zip(parts, bounds[:-1], bounds[1:], strict=True)
            if part
        ]
        found.sort(key=lambda part: -np.count_nonzero(np.isfinite(part.corners[..., 0])))
        if not found or len(found) == 1:
            return found[0] if proven and found else None
        if not (self._are_apart if proven else self._contradict)([one.corners for one in found]):
            return None
        largest, reason = found[0], "the image is torn, and its parts do not fit together"
        if not np.isfinite(largest.corners).any():
            return self._missing(GridFault.AMBIGUOUS, f"{reason}; {largest.reason}")
        return replace(largest, reason=reason, fault=GridFault.TWO_PATTERNS)

    def _are_apart(self, parts: list[NDArray[np.float64]]) -> bool:
        """Whether a part (rows, cols, 2) is not seen to continue those that continue the first."""
        whole, left = parts[0], parts[1:]
        while left:
            near = next((p for p in left if continues(whole, p, self._nominal)), None)
            if near is None:
                return True
            whole = np.where(np.isnan(whole), near, whole)
            left = [part for part in left if part is not near]
        return False

    def _contradict(self, parts: list[NDArray[np.float64]]) -> bool:
        """Whether two of the parts are seen not to continue each other."""
        return any(
            continues(one, other, self._nominal) is False for one, other in combinations(parts, 2)
        )

    def _numbered(
        self,
        components: list[Component],
        image: PreparedImage,
        previous: NDArray[np.float64] | None,
    ) -> Numbering:
        """The components of an image, or of one part of it, largest first."""
        if self._code is not None:
            by_code = self._code.number(components, image)
            if by_code is not None:
                return by_code
            components, reason = without_blurred(components, image)
            if not components:
                return self._missing(GridFault.NO_CONTRAST, reason)
        return self._numbered_by_border(components, image, previous)

    def _numbered_by_border(
        self,
        components: list[Component],
        image: PreparedImage,
        previous: NDArray[np.float64] | None,
    ) -> Numbering:
        """The components in which light and dark can be trusted, by where the pattern ends."""
        anchors = self._anchors(components, image, previous)
        corners = np.full_like(self._nominal.corners, np.nan)
        placed = []
        for index, anchor in enumerate(anchors):
            if anchor.shift is None:
                continue
            refused = self._place(corners, components[index], anchor.shift, previous)
            if refused is not None:
                return self._unplaced(components, refused)
            placed.append(index)
        if not placed:
            return self._unplaced(components, anchors[0])
        if not in_order(corners, self._nominal):
            return self._missing(GridFault.AMBIGUOUS, "gridlines are stretched or out of order")
        left = [component for index, component in enumerate(components) if index not in placed]
        confidence = self._confidence([anchors[index] for index in placed])
        return self._with_further(corners, left, confidence)

    def _unplaced(self, components: list[Component], anchor: Anchor) -> Numbering:
        """What is reported where no component has a place.

        What is wrong with the description only a whole pattern shows: a piece of one, behind
        something that hides the rest, may end anywhere, and has little shape.
        """
        pieces = sum(len(component.position) >= FEWEST_CORNERS for component in components)
        if anchor.fault not in OF_THE_DESCRIPTION or pieces < 2:
            return self._missing(anchor.fault, anchor.reason)
        reason = f"the pattern is seen in {pieces} pieces, and none shows its place"
        return self._missing(GridFault.AMBIGUOUS, reason)

    def confirms(self, corners: NDArray[np.float64], image: PreparedImage) -> bool:
        """Whether the pattern's code shows that corners (rows, cols, 2) px have right numbers."""
        return self._code is not None and self._code.confirms(corners, image)

    def _missing(self, fault: GridFault, reason: str) -> Numbering:
        return Numbering.nothing(self._nominal.corners.shape[:2], fault, reason)

    def _anchors(
        self,
        components: list[Component],
        image: PreparedImage,
        previous: NDArray[np.float64] | None,
    ) -> list[Anchor]:
        """What each of the large components shows of its own place, at least the largest's."""
        enough = SMALLEST_ANCHORED * self._nominal.corners[..., 0].size
        large = [component for component in components if len(component.position) >= enough]
        if len(components[0].position) < max(FEWEST_CORNERS, enough * BY_CHANCE):
            reason = (
                f"no checker pattern seen; {len(components[0].position)} corners are connected by "
                "chance"
            )
            return [Anchor(None, GridFault.NO_PATTERN, reason)]
        if not large:
            reason = f"only {len(components[0].position)} connected corners seen"
            return [Anchor(None, GridFault.AMBIGUOUS, reason)]
        anchors = [self._anchor.anchor(component, image, previous) for component in large]
        if all(anchor.shift is None for anchor in anchors):
            fault, reason = self._other_view(large[0])
            if fault is not GridFault.NONE:
                anchors[0] = Anchor(None, fault, reason)
            elif (
                anchors[0].fault is GridFault.OTHER_COLOURS
                and self._others.mirror_exchanges_colours
            ):
                anchors[0] = Anchor(None, GridFault.MIRRORED, COLOURS_OF_A_MIRROR_IMAGE)
        return anchors

    def _other_view(self, component: Component) -> tuple[GridFault, str]:
        """Whether a component fits nowhere because the view is mirrored or turned."""
        number = component.number - component.number.min(axis=0)
        if (number.max(axis=0) >= self._nominal.corners.shape[:2]).any():
            return GridFault.NONE, ""
        return self._others.seen_in(component.position, number)

    def _place(
        self,
        corners: NDArray[np.float64],
        component: Component,
        shift: NDArray[np.intp],
        previous: NDArray[np.float64] | None,
    ) -> Anchor | None:
        """Add an anchored component to the corners; else what is reported instead of a guess."""
        number = component.number + shift
        inside = ((number >= 0) & (number < corners.shape[:2])).all(axis=1)
        number, position = number[inside], component.position[inside]
        fault, reason = self._others.seen_in(position, number, previous)
        if fault is GridFault.NONE and len(position) >= FEWEST_CORNERS:
            few = len(position) < TURNED_SHARE * self._nominal.corners[..., 0].size
            largest = LARGEST_TURN_OF_PART if few else LARGEST_TURN
            reason = turned_reason(position, number, self._nominal, largest)
            fault = GridFault.TURNED if reason else GridFault.NONE
        if fault is GridFault.NONE and np.isfinite(corners[number[:, 0], number[:, 1], 0]).any():
            fault = GridFault.TWO_PATTERNS
            reason = "two patterns seen, and each could be the sensor's"
        if fault is not GridFault.NONE:
            return Anchor(None, fault, reason)
        corners[number[:, 0], number[:, 1]] = position
        # Of a complete grid every square closes: where a corner lies off, the fit decides.
        if np.isnan(corners).any():
            drop_loose_corners(corners, self._nominal.corners)
        return None

    def _with_further(
        self, corners: NDArray[np.float64], components: list[Component], confidence: float
    ) -> Numbering:
        """With the components that continue what is numbered, over again while some do."""
        left = list(components)
        joins, before = 0, -1
        while joins > before:
            before = joins
            for index, component in enumerate(left):
                shift = joined(corners, component, self._nominal, self._dark_first)
                if shift is not None:
                    i, j = (component.number + shift).T
                    corners[i, j] = component.position
                    left.pop(index)
                    joins += 1
                    break
        if np.isnan(corners).any():
            drop_loose_corners(corners, self._nominal.corners)
        other = max((len(item.position) for item in left if self._is_other(item)), default=0)
        return self._judged(corners, other, confidence * (JOINED_CONFIDENCE if joins else 1.0))

    def _is_other(self, component: Component) -> bool:
        """Whether a component's checkers differ from those of the pattern where it lies.

        Those that do not may be a piece of it that has no place of its own.
        """
        lattice, _ = component.lattice()
        known = np.isfinite(lattice[..., 0])
        off = []
        for axis, nominal in enumerate(self._connected.axes.near(lattice[known])):
            steps = np.full_like(lattice, np.nan)
            if lattice.shape[axis] > 1:
                steps = np.gradient(lattice, axis=axis)
            off.append(np.linalg.norm(steps[known] - nominal, axis=1))
        distance = np.concatenate(off)
        distance = distance[np.isfinite(distance)]
        return len(distance) > 0 and bool(np.median(distance) > OTHER_STEP * self._nominal.side_px)

    def _judged(self, corners: NDArray[np.float64], other: int, confidence: float) -> Numbering:
        """other: corners that are connected and fit nowhere, as they are not the pattern's."""
        missing = int(np.isnan(corners[..., 0]).sum())
        if not missing:
            return Numbering(corners, "", GridFault.NONE, confidence)
        if other >= OTHER_PATTERN * corners[..., 0].size:
            reason = f"{not_seen(missing)}, and {other} that do not belong to the pattern"
            return Numbering(corners, reason, GridFault.TWO_PATTERNS, confidence)
        reason = not_seen(missing)
        return Numbering(corners, reason, GridFault.PARTLY_HIDDEN, confidence)

    @staticmethod
    def _confidence(anchors: list[Anchor]) -> float:
        """By the sides at which one of the placed components or another was seen to end."""
        ends = np.any([anchor.ends for anchor in anchors], axis=0)
        found = float(UNSEEN_SIDE_CONFIDENCE ** (4 - np.count_nonzero(ends)))
        if any(_rests_on_one_border(anchors, axis) for axis in (0, 1)):
            found *= ONE_BORDER
        return found * (FAR_FROM_NOMINAL_CONFIDENCE if anchors[0].unlikely else 1.0)


def _rests_on_one_border(anchors: list[Anchor], axis: int) -> bool:
    """Whether every component does, and no two of them were seen to end on opposite sides."""
    if not all(anchor.one_border[axis] for anchor in anchors):
        return False
    return not any(
        one.ends[2 * axis] and other.ends[2 * axis + 1] for one, other in permutations(anchors, 2)
    )
