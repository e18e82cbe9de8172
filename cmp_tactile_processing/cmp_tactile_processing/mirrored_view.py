"""Tells a view that is mirrored or turned from one that is deformed."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.grid import GridFault
from cmp_tactile_processing.nominal_grid import NominalGrid

__all__ = ["OtherViews", "shape_misfit"]

# A deformed grid differs in shape from the nominal one by less than this, in sides, RMS.
LARGEST_DEFORMATION = 0.5
# Another view of the pattern must explain the corners this much better; where it explains them as
# well, within the same factor, only the last frame tells.
BETTER = 0.85
# A part of the grid that is strained can look like a turned part of it, unless it is this large.
TURNED_SHARE = 0.6
# The last frame's corners speak for a place from which they moved less than this, in sides.
LITTLE_MOTION = 0.5
# Views whose nominal grids differ by less than this, in sides, cannot be told apart.
ALIKE = 0.4
# Fewer corners have little shape.
FEWEST_CORNERS = 40

QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
MIRROR = np.array([[-1.0, 0.0], [0.0, 1.0]])


class OtherViews:
    """The nominal grid mirrored or turned in the image, numbered as it would then be taken for."""

    def __init__(self, nominal: NominalGrid) -> None:
        self._nominal = nominal
        self._others: list[tuple[GridFault, NDArray[np.float64]]] = []
        for turns, mirrored in product(range(4), (False, True)):
            change = np.linalg.matrix_power(QUARTER_TURN, turns)
            change = change @ MIRROR if mirrored else change
            seen = _renumbered(nominal.corners @ change.T, nominal)
            everywhere = np.indices(seen.shape[:2]).reshape(2, -1).T
            if shape_misfit(seen.reshape(-1, 2), everywhere, nominal.corners, nominal) > ALIKE:
                fault = GridFault.MIRRORED if mirrored else GridFault.TURNED
                self._others.append((fault, seen))

    def seen_in(
        self,
        position: NDArray[np.float64],
        number: NDArray[np.intp],
        previous: NDArray[np.float64] | None = None,
    ) -> tuple[GridFault, str]:
        """MIRRORED or TURNED where corners (n, 2) px and their numbers show it, else NONE.

        AMBIGUOUS where a turned view fits the whole grid as well and previous, the last frame's
        corners (rows, cols, 2) px, does not tell.
        """
        if len(position) < FEWEST_CORNERS:
            return GridFault.NONE, ""
        own = shape_misfit(position, number, self._nominal.corners, self._nominal)
        # Views differ by more than ALIKE: none fits nearly as well as one that fits so well.
        if own < ALIKE * BETTER / (1 + BETTER):
            return GridFault.NONE, ""
        mirrored = turned = np.inf
        if own > LARGEST_DEFORMATION:
            mirrored = self._least(GridFault.MIRRORED, position, number)
        if len(position) >= TURNED_SHARE * self._nominal.corners[..., 0].size:
            turned = self._least(GridFault.TURNED, position, number)
        if mirrored < min(BETTER * own, turned):
            return GridFault.MIRRORED, (
                "the view is a mirror image of the expected one; "
                "check views.<view>.mirror and views.<view>.roi in the sensor's description"
            )
        if turned < BETTER * own:
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


def shape_misfit(
    position: NDArray[np.float64],
    number: NDArray[np.intp],
    corners: NDArray[np.float64],
    nominal: NominalGrid,
) -> float:
    """RMS distance in sides of numbered corners from a grid's, wherever that grid lies."""
    apart = position - corners[number[:, 0], number[:, 1]]
    return float(np.sqrt(apart.var(axis=0).sum()) / nominal.side_px)


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
