"""Numbers the corners of a view: right, or missing with a reason."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.corner_graph import CornerGraph, Island
from cmp_tactile_processing.grid import GridFault
from cmp_tactile_processing.gridline_pointer import GridlinePointers
from cmp_tactile_processing.island_anchor import FEWEST_CORNERS, Anchor, IslandAnchor
from cmp_tactile_processing.island_join import in_order, joined
from cmp_tactile_processing.loose_corners import drop_loose_corners
from cmp_tactile_processing.mirrored_view import OtherViews
from cmp_tactile_processing.nominal_grid import NominalAxes, NominalGrid
from cmp_tactile_processing.prepared_image import PreparedImage

__all__ = ["GridNumbering", "Numbering", "without_strays"]

# An island that is to be anchored by itself has this share of the corners at least.
SMALLEST_ANCHORED = 0.1
# On a cluttered image without pattern corners connect by chance: up to this share of those.
BY_CHANCE = 0.5
# Islands of fewer corners are clutter as often as they are part of the pattern.
SMALLEST_JOINED = 2
# Corners with this share of the grid's that fit nowhere are another pattern.
OTHER_PATTERN = 0.1
# Fewer corners that the fit cannot join to the rest are the rim of something that hides the gel.
FEWEST_STRAYS = 6
# What is left of the confidence for each side at which the pattern was not seen to end, where the
# corners lie far from the nominal projection, and where islands were joined across a gap.
UNSEEN_SIDE, FAR_FROM_NOMINAL, JOINED = 0.95, 0.9, 0.9


@dataclass(frozen=True)
class Numbering:
    """corners (rows, cols, 2) px, NaN where missing; reason, fault: why some are, else empty.

    confidence: 1 for a complete grid that was seen to end on all four sides and fits the nominal
    projection; each missing piece of evidence takes a fixed share.  It orders numberings by their
    evidence and is no measured probability; what could be wrong by the evidence is left out
    whatever the confidence.  0 where nothing is numbered.
    """

    corners: NDArray[np.float64]
    reason: str
    fault: GridFault = GridFault.NONE
    confidence: float = 0.0


def without_strays(numbering: Numbering, strays: int, missing: int) -> Numbering:
    """What is to be said where so many numbered corners turned out to be another pattern's.

    missing: corners without a position in the end.
    """
    if strays < FEWEST_STRAYS:
        return numbering
    reason = f"{missing} corners not seen, and {strays} that do not belong to the pattern"
    return replace(numbering, reason=reason, fault=GridFault.TWO_PATTERNS)


class GridNumbering:
    """Numbers the corners that a detector found in one view; keeps its buffers.

    nominal: in pixels of the prepared image; dark_first: whether the checker outside corner (0, 0)
    is a dark one.
    """

    def __init__(self, nominal: NominalGrid, dark_first: bool) -> None:
        self._nominal = nominal
        self._dark_first = dark_first
        self._axes = NominalAxes(nominal)
        self._pointers = GridlinePointers()
        self._anchor = IslandAnchor(nominal, dark_first)
        self._others = OtherViews(nominal)

    def number(
        self,
        graph: CornerGraph,
        image: PreparedImage,
        previous: NDArray[np.float64] | None = None,
    ) -> Numbering:
        """Numbered corners of a graph, all in pixels of the prepared image.

        previous: (rows, cols, 2) px, the last frame's corners, NaN where they were missing.

        Corners are numbered by the gridlines that connect them, each connected set is anchored by
        itself or by those that are anchored already; see `IslandAnchor` and `joined`.
        """
        steps = self._axes.near(graph.position)
        islands = self._pointers.islands(graph, *steps, fewest=SMALLEST_JOINED)
        if not islands:
            return self._missing(GridFault.NO_PATTERN, "no checker pattern seen")
        anchors = self._anchors(islands, image, previous)
        corners = np.full_like(self._nominal.corners, np.nan)
        placed = []
        for index, anchor in enumerate(anchors):
            if anchor.shift is None:
                continue
            refused = self._place(corners, islands[index], anchor.shift, previous)
            if refused is not None:
                return refused
            placed.append(index)
        if not placed:
            return self._missing(anchors[0].fault, anchors[0].reason)
        anchor = anchors[placed[0]]
        if not in_order(corners, self._nominal):
            return self._missing(GridFault.AMBIGUOUS, "gridlines are stretched or out of order")
        left = [island for index, island in enumerate(islands) if index not in placed]
        return self._with_further(corners, left, anchor)

    def _missing(self, fault: GridFault, reason: str) -> Numbering:
        return Numbering(np.full_like(self._nominal.corners, np.nan), reason, fault, 0.0)

    def _anchors(
        self,
        islands: list[Island],
        image: PreparedImage,
        previous: NDArray[np.float64] | None,
    ) -> list[Anchor]:
        """What each of the large islands tells of its own place, at least the largest's."""
        enough = SMALLEST_ANCHORED * self._nominal.corners[..., 0].size
        large = [island for island in islands if len(island.position) >= enough]
        if len(islands[0].position) < max(FEWEST_CORNERS, enough * BY_CHANCE):
            reason = (
                f"no checker pattern seen, {len(islands[0].position)} corners connect by chance"
            )
            return [Anchor(None, GridFault.NO_PATTERN, reason)]
        if not large:
            reason = f"only {len(islands[0].position)} connected corners seen"
            return [Anchor(None, GridFault.AMBIGUOUS, reason)]
        anchors = [self._anchor.anchor(island, image, previous) for island in large]
        if all(anchor.shift is None for anchor in anchors):
            fault, reason = self._other_view(large[0])
            if fault is not GridFault.NONE:
                anchors[0] = Anchor(None, fault, reason)
        return anchors

    def _other_view(self, island: Island) -> tuple[GridFault, str]:
        """Whether an island fits nowhere because the view is mirrored or turned."""
        number = island.number - island.number.min(axis=0)
        if (number.max(axis=0) >= self._nominal.corners.shape[:2]).any():
            return GridFault.NONE, ""
        return self._others.seen_in(island.position, number)

    def _place(
        self,
        corners: NDArray[np.float64],
        island: Island,
        shift: NDArray[np.intp],
        previous: NDArray[np.float64] | None,
    ) -> Numbering | None:
        """Add an anchored island to the corners; else what is reported instead of a guess."""
        number = island.number + shift
        inside = ((number >= 0) & (number < corners.shape[:2])).all(axis=1)
        number, position = number[inside], island.position[inside]
        fault, reason = self._others.seen_in(position, number, previous)
        if fault is GridFault.NONE and np.isfinite(corners[number[:, 0], number[:, 1], 0]).any():
            fault = GridFault.TWO_PATTERNS
            reason = "two patterns seen, each of which could be the sensor's"
        if fault is not GridFault.NONE:
            return self._missing(fault, reason)
        corners[number[:, 0], number[:, 1]] = position
        # Of a complete grid every square closes: where a corner lies off, the fit decides.
        if np.isnan(corners).any():
            drop_loose_corners(corners, self._nominal.corners)
        return None

    def _with_further(
        self, corners: NDArray[np.float64], islands: list[Island], anchor: Anchor
    ) -> Numbering:
        """With the islands that continue what is numbered, over again while some do."""
        left = list(islands)
        joins, before = 0, -1
        while joins > before:
            before = joins
            for index, island in enumerate(left):
                shift = joined(corners, island, self._nominal, self._dark_first)
                if shift is not None:
                    i, j = (island.number + shift).T
                    corners[i, j] = island.position
                    left.pop(index)
                    joins += 1
                    break
        if np.isnan(corners).any():
            drop_loose_corners(corners, self._nominal.corners)
        largest = max((len(island.position) for island in left), default=0)
        return self._judged(corners, largest, anchor, joins)

    def _judged(
        self, corners: NDArray[np.float64], other: int, anchor: Anchor, joins: int
    ) -> Numbering:
        """other: corners that are connected and fit nowhere."""
        confidence = self._confidence(anchor) * (JOINED if joins else 1.0)
        missing = int(np.isnan(corners[..., 0]).sum())
        if not missing:
            return Numbering(corners, "", GridFault.NONE, confidence)
        if other >= OTHER_PATTERN * corners[..., 0].size:
            reason = f"{missing} corners not seen, and {other} that do not belong to the pattern"
            return Numbering(corners, reason, GridFault.TWO_PATTERNS, confidence)
        reason = f"{missing} corners not seen"
        return Numbering(corners, reason, GridFault.PARTLY_HIDDEN, confidence)

    @staticmethod
    def _confidence(anchor: Anchor) -> float:
        found = float(UNSEEN_SIDE ** (4 - anchor.proofs))
        return found * (FAR_FROM_NOMINAL if anchor.unlikely else 1.0)
