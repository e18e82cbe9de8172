"""Views that show the pattern otherwise than described: mirrored or turned, not deformed."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured import GridFault
from cmp_tactile_processing.tracking.detector import NominalGrid

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
# A part of a grid fits another view in some of its places: where less than the first of these
# shares is seen, the other view has to explain the corners this much better.
NEARLY_WHOLE, SURELY_BETTER = 0.9, 0.5
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
        sure = BETTER if share >= NEARLY_WHOLE else SURELY_BETTER
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
