"""Numbers that are carried from frame to frame, for a pattern that goes on beyond the view.

Without a border nothing in an image says which corner is which.  The first frame numbers corners by
the nominal corners that they lie next to; from then on each frame takes over the numbers of the one
before, by where its corners were and how fast they moved.  Colours leave every second number only,
so that the next one that is possible lies 1.4 checkers away.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.measured import GridFault
from cmp_tactile_processing.tracking.detector import (
    Component,
    CornerGraph,
    NominalAxes,
    NominalGrid,
)
from cmp_tactile_processing.tracking.numbering.component_placement import ConnectedCorners
from cmp_tactile_processing.tracking.numbering.faulty_view import (
    cut_at,
    proven_tears,
    turned_reason,
)
from cmp_tactile_processing.tracking.numbering.joining import drop_loose_corners, placed
from cmp_tactile_processing.tracking.numbering.result import Numbering

Float = NDArray[np.float64]
Whole = NDArray[np.intp]

# Numbers are certain up to this median distance of corners from their expected places, in sides;
# those of the next possible numbers are beyond 0.9.
MAX_CARRIED_DISTANCE_SIDES = 0.5
# The same after frames without the pattern.
MAX_RETURN_DISTANCE_SIDES = 0.25
# Corners vote for the shift of the numbers: at most so many of those that are near, in sides, to
# where a corner is expected.
MAX_VOTES = 400
MAX_VOTE_DISTANCE_SIDES = 1.5
# Shifts up to this many numbers around the one with the most votes are tried.
SEARCHED_SHIFT = 3
# From frame to frame most of a gel moves as a whole, turned and stretched alike.  In a quick press
# up to this remains, in sides; if more does, another shift of the numbers may be the right one.
MAX_CERTAIN_CHANGE_SIDES = 0.02
# It is a rival if it leaves at most this many times as much.  After a jump by whole checkers the
# shapes do not match.
MAX_RIVAL_CHANGE_RATIO = 1.15
# It is no rival if fewer than this share of the corners remain on the grid.
MIN_RIVAL_CORNER_SHARE = 0.6
ROUNDS, LEAST_LEFT = 5, 1e-4
# On an image without a pattern some corners connect by chance.  The first component has at least
# this share of the grid's corners, within these limits.
MIN_FIRST_SHARE = 0.05
MIN_FIRST_CORNERS = 12
MAX_CHANCE_CORNERS = 36
# Each further component has at least this many corners.
MIN_FURTHER_CORNERS = 4
# A component with fewer corners than this is used only within MAX_GAP checkers of numbered ones.
MIN_CORNERS_BEYOND_GAP = 40
MAX_GAP = 3.0
# What a number is worth that neither border nor code confirms.
CONFIDENCE = 0.5


class CarriedNumbering:
    """Numbers the corners of one view by the frames before.

    nominal: in pixels of the prepared image; dark_first: whether the checker outside corner (0, 0)
    is a dark one.
    """

    def __init__(self, nominal: NominalGrid, dark_first: bool) -> None:
        self._nominal, self._dark_first = nominal, dark_first
        steps = np.stack([nominal.row_step, nominal.col_step])
        self._side = np.linalg.norm(steps, axis=-1).mean(axis=0)
        self._numbers = np.argwhere(np.ones(self._side.shape, dtype=bool))
        self._even = (self._numbers.sum(axis=1) % 2 == 0) == dark_first
        self._connected = ConnectedCorners(NominalAxes(nominal))
        self.reset()

    def reset(self) -> None:
        """Forget all frames: the next one is numbered as a first one."""
        self._first: Float | None = None
        self._last: Float | None = None
        self._speed: Float | None = None

    def saw(self, corners: Float) -> None:
        """Take over a frame's corners (rows, cols, 2) px, NaN where missing."""
        last, self._speed = self._last, None
        if np.isnan(corners).all():
            return
        self._last, _ = filled(corners, self._before)
        if self._first is None:
            self._first = self._last
        elif last is not None:
            self._speed = self._last - last

    def goes_on(self, corners: Float) -> bool:
        """Whether a grid (rows, cols, 2) px, NaN where missing, continues the last frame.

        It does not where other numbers explain it as well, after a jump by whole checkers.
        """
        if self._last is None:
            return True
        known = np.isfinite(corners[..., 0]).ravel()
        position = corners.reshape(-1, 2)[known]
        component = Component(position, self._numbers[known], self._even[known])
        shift = self._certain(component, self._last, MAX_CARRIED_DISTANCE_SIDES)
        return shift is not None and not shift.any()

    def number(
        self, graph: CornerGraph, image: PreparedImage, previous: Float | None, torn: list[int]
    ) -> Numbering:
        """Numbered corners of a graph, all in pixels of the prepared image.

        previous: the last frame's corners, None where it had none: the numbers are lost.
        torn: what `torn_rows` finds in the image.  Corners beyond the grid are left out.
        """
        side = self._nominal.side_px
        jumps = proven_tears(graph, torn, image, side)
        graph = cut_at(graph, jumps, side) if jumps else graph
        components, reason = self._connected.components(graph, image)
        fewest = np.clip(MIN_FIRST_SHARE * self._side.size, MIN_FIRST_CORNERS, MAX_CHANCE_CORNERS)
        if not components or len(components[0].position) < fewest:
            fault = GridFault.NO_CONTRAST if reason else GridFault.NO_PATTERN
            return self._none(fault, reason or "no checker pattern seen")
        bounds = [-np.inf, *jumps, np.inf]
        part = int(np.searchsorted(jumps, components[0].position[0, 1]))
        between = bounds[part], bounds[part + 1]
        shift, reason = self._shift_of_largest(components[0], lost=previous is None)
        if shift is None:
            return self._none(GridFault.AMBIGUOUS, reason)
        corners = np.full_like(self._nominal.corners, np.nan)
        placed(corners, components[0], shift)
        if self._last is None:
            known = np.isfinite(corners[..., 0])
            turned = turned_reason(corners[known], np.argwhere(known), self._nominal)
            if turned:
                return self._none(GridFault.TURNED, turned)
        further = [item for item in components[1:] if len(item.position) >= MIN_FURTHER_CORNERS]
        self._place_beside(
            corners, [item for item in further if between[0] < item.position[0, 1] < between[1]]
        )
        if np.isnan(corners).any():
            drop_loose_corners(corners, self._nominal.corners)
        fault = GridFault.PARTLY_HIDDEN if np.isnan(corners).any() else GridFault.NONE
        return Numbering(corners, "", fault, CONFIDENCE, between)

    def _none(self, fault: GridFault, reason: str) -> Numbering:
        return Numbering.nothing(self._side.shape, fault, reason)

    def _shift_of_largest(self, component: Component, *, lost: bool) -> tuple[Whole | None, str]:
        """What to add to the numbers of the largest set; None, and why, where that is in doubt."""
        if self._last is None:
            return self._at_centre(component), ""
        if lost:
            places, limit = [self._last, self._first], MAX_RETURN_DISTANCE_SIDES
        else:
            places, limit = [self._last], MAX_CARRIED_DISTANCE_SIDES
            if self._speed is not None:
                places.append(self._last + self._speed)
        found = [self._certain(component, place, limit) for place in places if place is not None]
        shifts = {tuple(shift.tolist()) for shift in found if shift is not None}
        if len(shifts) == 1:
            return np.array(shifts.pop(), dtype=np.intp), ""
        if lost:
            return None, "the pattern has not returned to where its numbers were lost"
        return None, "the pattern has moved too far since the last frame to keep its numbers"

    def _at_centre(self, component: Component) -> Whole:
        """The shift that numbers the corner nearest to the centre of the grid by where it lies.

        There a pattern that is turned or of another scale is off least.
        """
        flat = self._nominal.corners.reshape(-1, 2)
        nearest = np.linalg.norm(component.position - flat.mean(axis=0), axis=1).argmin()
        off = np.linalg.norm(flat - component.position[nearest], axis=1)
        off[self._even != component.even[nearest]] = np.inf
        return np.asarray(self._numbers[off.argmin()] - component.number[nearest])

    def _certain(self, component: Component, expected: Float, limit: float) -> Whole | None:
        """The shift by which corners lie nearest to where they are expected.

        expected (rows, cols, 2) px; limit: in sides.  None beyond it, and where another number
        explains the corners as well.
        """
        tried = self._tried(component, expected)
        best = _nearest(tried, limit)
        if best is None:
            return None
        change, count = best.change(), MIN_RIVAL_CORNER_SHARE * len(best.number)
        rivals = (place for place in tried if place is not best and len(place.number) >= count)
        if change > MAX_CERTAIN_CHANGE_SIDES and any(
            rival.change() <= MAX_RIVAL_CHANGE_RATIO * change for rival in rivals
        ):
            return None
        return best.shift

    def _tried(self, component: Component, expected: Float) -> list[_Place]:
        """Places around the one that most corners vote for, with the colours that they have."""
        size = np.array(self._side.shape)
        away, nearest = cKDTree(expected.reshape(-1, 2)).query(component.position)
        near = np.flatnonzero(away <= MAX_VOTE_DISTANCE_SIDES * self._nominal.side_px)
        if not len(near):
            return []
        chosen = near[np.linspace(0, len(near) - 1, min(MAX_VOTES, len(near))).astype(np.intp)]
        position, number = component.position[chosen], component.number[chosen]
        nearest = nearest[chosen]
        votes = np.stack(np.divmod(nearest, size[1]), axis=1) - number
        values, counts = np.unique(votes, axis=0, return_counts=True)
        voted = values[counts.argmax()]
        found = []
        for step in product(range(-SEARCHED_SHIFT, SEARCHED_SHIFT + 1), repeat=2):
            shift = voted + np.array(step)
            on_even = int((number[0] + shift).sum()) % 2 == 0
            if (bool(component.even[chosen[0]]) == on_even) != self._dark_first:
                continue
            at = number + shift
            inside = ((at >= 0) & (at < size)).all(axis=1)
            if inside.any():
                i, j = at[inside].T
                moved = (position[inside] - expected[i, j]) / self._side[i, j][:, None]
                found.append(_Place(shift, at[inside], moved))
        return found

    def _place_beside(self, corners: Float, components: list[Component]) -> None:
        """Add sets of corners where they continue those that have their place."""
        around = None
        for component in components:
            expected, gap = around = around or filled(corners, self._before)
            best = _nearest(self._tried(component, expected), MAX_CARRIED_DISTANCE_SIDES)
            if best is None:
                continue
            i, j = np.clip(component.number + best.shift, 0, np.array(gap.shape) - 1).T
            is_near = (
                len(component.position) >= MIN_CORNERS_BEYOND_GAP or gap[i, j].min() <= MAX_GAP
            )
            if is_near and placed(corners, component, best.shift):
                around = None

    @property
    def _before(self) -> Float:
        """Where corners were in the last frame, or at first the nominal projection."""
        return self._nominal.corners if self._last is None else self._last


def filled(corners: Float, before: Float) -> tuple[Float, Float]:
    """Corners with those that are missing where the others let expect them, and their gap.

    corners, before (rows, cols, 2) px, NaN in corners where missing.  The missing ones have moved
    since `before` as all together, turned and stretched alike, and by what the nearest one in the
    grid differs from that.  gap (rows, cols): distance of that one, in checkers.
    """
    known = np.isfinite(corners[..., 0])
    place = np.stack([*np.indices(known.shape), np.ones(known.shape)], axis=-1)
    fit = np.linalg.lstsq(place[known], (corners - before)[known], rcond=None)
    smooth = before + place @ fit[0]
    gap, (i, j) = distance_transform_edt(~known, return_indices=True)
    return np.asarray(smooth + (corners - smooth)[i, j]), gap


class _Place(NamedTuple):
    """What to add to a set's numbers, the numbers (n, 2) that gives, how its corners then moved.

    moved (n, 2): in sides.
    """

    shift: Whole
    number: Whole
    moved: Float

    @property
    def off(self) -> float:
        """Median length of the motion, in sides."""
        return float(np.median(np.linalg.norm(self.moved, axis=1)))

    def change(self) -> float:
        """Median of the motion in sides, less that of most as a whole that turns and stretches."""
        terms = np.column_stack([self.number, np.ones(len(self.number))])
        weight, left = np.ones((len(terms), 1)), np.zeros(len(terms))
        for _ in range(ROUNDS):
            fit = np.linalg.lstsq(weight * terms, weight * self.moved, rcond=None)[0]
            left = np.linalg.norm(self.moved - terms @ fit, axis=1)
            # What is pressed aside counts less.
            weight = 1 / np.hypot(1.0, left / max(float(np.median(left)), LEAST_LEFT))[:, None]
        return float(np.median(left))


def _nearest(tried: list[_Place], limit: float) -> _Place | None:
    """The place by which corners have moved least; None beyond a limit, in sides."""
    best = min(tried, key=lambda place: place.off, default=None)
    return None if best is None or best.off > limit else best
