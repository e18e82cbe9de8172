"""Anchors a connected set of corners to the pattern's numbers, or says why it cannot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.corner_graph import CornerGraph, Island
from cmp_tactile_processing.grid import GridFault
from cmp_tactile_processing.gridline_pointer import drop_strained, traverse
from cmp_tactile_processing.nominal_grid import NominalGrid
from cmp_tactile_processing.prepared_image import PreparedImage

__all__ = ["GridNumbering", "Numbering", "number_corners"]

# An incomplete set is anchored by its least displaced corners: the gel moves least at its rim.
ANCHOR_QUANTILE = 0.2
# The best place must fit within this, and beat the next one by this; in sides of a checker.
ANCHOR_FIT, ANCHOR_LEAD = 0.5, 0.4
SMALLEST_ISLAND = 0.25
# An outermost line with fewer corners than this share of its length is no line of the pattern.
LEAST_SUPPORT = 0.2


@dataclass(frozen=True)
class Numbering:
    """corners (rows, cols, 2) px, NaN where missing; reason, fault: why some are, else empty.

    confidence: 0 to 1, how surely the corners bear their right numbers.
    """

    corners: NDArray[np.float64]
    reason: str
    fault: GridFault = GridFault.NONE
    confidence: float = float("nan")


class GridNumbering:
    """Numbers the corners that a detector found.

    nominal: in pixels of the prepared image; dark_first: whether the checker outside corner (0, 0)
    is a dark one.
    """

    def __init__(self, nominal: NominalGrid, dark_first: bool) -> None:
        self._nominal = nominal
        self._dark_first = dark_first

    def number(
        self,
        graph: CornerGraph,
        image: PreparedImage,  # noqa: ARG002
        previous: NDArray[np.float64] | None = None,  # noqa: ARG002
    ) -> Numbering:
        """Numbered corners of a graph, all in pixels of the prepared image.

        previous: (rows, cols, 2) px, the last frame's corners, NaN where they were missing.
        """
        graph = drop_strained(graph, *self._nominal.axes_near(graph.position))
        numbering = number_corners(traverse(graph), self._nominal, self._dark_first)
        missing = np.isnan(numbering.corners[..., 0])
        if not missing.any():
            return Numbering(numbering.corners, "", GridFault.NONE, 1.0)
        if missing.all():
            return Numbering(numbering.corners, numbering.reason, GridFault.AMBIGUOUS, 0.0)
        return Numbering(numbering.corners, numbering.reason, GridFault.PARTLY_HIDDEN, 0.7)


def number_corners(islands: list[Island], nominal: NominalGrid, first_even: bool) -> Numbering:
    """Place the largest set of connected corners on the grid.

    A complete set fits in one way only.  An incomplete one is placed where its least displaced
    corners fit the nominal projection, and left out where two places fit alike: a wrong number
    is worse than a missing corner.  first_even: whether the checkers of the colour in question
    touch corner (0, 0) along the diagonal (-, -) to (+, +).
    """
    rows, cols = nominal.corners.shape[:2]
    corners = np.full((rows, cols, 2), np.nan)
    if not islands:
        return Numbering(corners, "no checker pattern seen")
    island = _without_stragglers(islands[0])
    number = island.number
    extent = number.max(axis=0) + 1
    if (extent > (rows, cols)).any():
        reason = f"found {extent[0]} x {extent[1]} corners, expected {rows} x {cols}"
        return Numbering(corners, reason)
    shift, reason = _anchor(island, nominal, first_even)
    if shift is None:
        return Numbering(corners, reason)
    i, j = (number + shift).T
    corners[i, j] = island.position
    missing = int(np.isnan(corners[..., 0]).sum())
    return Numbering(corners, f"{missing} corners not seen" if missing else "")


def _without_stragglers(island: Island) -> Island:
    """The island numbered from (0, 0), without outermost lines of a few stray corners."""
    while True:
        number = island.number - island.number.min(axis=0)
        extent = number.max(axis=0) + 1
        stray = np.zeros(len(number), dtype=bool)
        for axis in (0, 1):
            for outermost in (0, extent[axis] - 1):
                line = number[:, axis] == outermost
                if line.sum() < LEAST_SUPPORT * extent[1 - axis]:
                    stray |= line
        island = Island(island.position, number, island.even)
        if not stray.any() or stray.all():
            return island
        island = Island(island.position[~stray], number[~stray], island.even[~stray])


def _anchor(
    island: Island, nominal: NominalGrid, first_even: bool
) -> tuple[NDArray[np.intp] | None, str]:
    rows, cols = nominal.corners.shape[:2]
    number = island.number
    extent = number.max(axis=0) + 1
    even_here = bool(island.even[0]) == (int(number[0].sum()) % 2 == 0)
    candidates = [
        (di, dj)
        for di in range(rows - extent[0] + 1)
        for dj in range(cols - extent[1] + 1)
        if ((di + dj) % 2 == 0) == (even_here == first_even)
    ]
    if not candidates:
        return None, "colours do not fit: the pattern seems shifted, mirrored or inverted"
    if (extent == (rows, cols)).all():
        return np.array(candidates[0], dtype=np.intp), ""
    if len(island.position) < SMALLEST_ISLAND * rows * cols:
        return None, f"only {len(island.position)} connected corners seen"
    misfit = [_misfit(island, number + shift, nominal) for shift in candidates]
    order = np.argsort(misfit)
    best = misfit[order[0]]
    if best > ANCHOR_FIT:
        return None, f"nearest place is {best:.1f} checkers from the nominal projection"
    if len(order) > 1 and misfit[order[1]] - best < ANCHOR_LEAD:
        return None, "two places on the grid fit alike"
    return np.array(candidates[order[0]], dtype=np.intp), ""


def _misfit(island: Island, number: NDArray[np.intp], nominal: NominalGrid) -> float:
    """Distance of the least displaced corners from their nominal places, in sides."""
    i, j = number.T
    distance = np.linalg.norm(island.position - nominal.corners[i, j], axis=1)
    side = np.linalg.norm(nominal.col_step[i, j], axis=1)
    return float(np.quantile(distance / side, ANCHOR_QUANTILE))
