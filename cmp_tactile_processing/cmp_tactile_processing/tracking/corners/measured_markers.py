"""Measured markers: sub-pixel corners of a numbered grid, checked against the image around them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.tracking.corners.evidence import (
    LEAST_ENCLOSED_QUALITY,
    LEAST_QUALITY,
    WEAKEST_ENCLOSED,
    WEAKEST_RING,
    compare,
    find_edges,
    measure_bends,
    ring_evidence,
)
from cmp_tactile_processing.tracking.corners.neighbours import (
    border_of,
    edge_crossings,
    known_beside,
    local_steps,
    off_neighbours,
    outside_corners,
    place_between,
    predicted_places,
)
from cmp_tactile_processing.tracking.corners.saddle_point import SaddlePointFit
from cmp_tactile_processing.tracking.corners.stray_parts import drop_stray_parts
from cmp_tactile_processing.tracking.detector import NominalGrid

# Shares of the local checker side: how far the fit may move a corner, and how far a corner may lie
# from where its neighbours predict it.
REFINE_REACH, COMPLETE_REACH = 0.35, 0.25
# A spot displaces a corner if it lies farther than this from the cubics through its neighbours, in
# sides, and farther than this many times the median of the corners around it,
MAX_SMOOTH_OFFSET_SIDES = 0.05
MAX_SMOOTH_OFFSET_RATIO = 3.0
# and if its gridlines cross farther away than this, in sides.
MIN_CROSSING_OFFSET_SIDES = 0.06
# A spot weakens the rings around a corner, or its rim spoils the fit.  If the rings are at least
# this strong against those around, or the deviation of the fit is below this, in sides, the gel
# bends there.
MIN_WHOLE_RING_RATIO = 0.96
MAX_CLEAR_STD_SIDES = 0.0015
# The fitted model does not bend as sharply: its error in px for each side that the corner is off.
BEND_ERROR_PX_PER_SIDE = 2.0
# If no crossing is better, a corner that is off by more than this is no measurement, in sides.
MAX_DISPLACED_OFFSET_SIDES = 0.15
# Nor is a corner beside missing ones whose displacement differs from that of the others by more
# than this, in sides, and than this many times the median difference.
MAX_RIM_OFFSET_SIDES = 0.08
MAX_RIM_OFFSET_RATIO = 5.0
# Standard deviation of a corner measured as a crossing, and of one that lies between its
# neighbours where a spot lets nothing else be measured, in sides.
CROSSING_STD, BETWEEN_STD = 0.008, 0.02
MAX_COMPLETION_ROUNDS = 8
REPAIR_ROUNDS = 3
# So few missing corners are a flaw of the print, in all or in each gap.
MAX_FLAW_CORNERS = 3
# The pattern continues beyond a border if this share of the border's corners does, or so long a
# row of them (share of the border, number): the lower part of a torn image may be shifted by whole
# checkers.
MIN_CONTINUED_SHARE = 0.5
MIN_CONTINUED_RUN_SHARE = 0.15
MIN_CONTINUED_RUN = 3
# A corner this near to a tear of the image is of neither part and is left out, in sides.
NEAR_TEAR = 0.15


@dataclass(frozen=True)
class _Likeness:
    """Corners (rows, cols) that look like those around them, or at least similar."""

    alike: NDArray[np.bool_]
    similar: NDArray[np.bool_]


@dataclass(frozen=True)
class _Surroundings:
    """Steps along i and along j, (rows, cols, 2) px, and the amplitude (rows, cols), with its sign,
    of a whole corner at each place.
    """

    row_step: NDArray[np.float64]
    col_step: NDArray[np.float64]
    amplitude: NDArray[np.float64]

    def crossings(
        self, image: PreparedImage, guess: NDArray[np.float64], wanted: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Crossings of the gridlines near the guesses of the wanted corners, (n, 2) px."""
        return edge_crossings(
            image.smooth,
            guess[wanted],
            self.row_step[wanted],
            self.col_step[wanted],
            self.amplitude[wanted],
        )


class MeasuredMarkers:
    """Measures the corners of one view's grid.

    nominal: the grid at rest, in pixels of the prepared image.  dark_first: dark checkers touch
    corner (0, 0) along the diagonal (-, -) to (+, +).
    """

    def __init__(self, nominal: NominalGrid, dark_first: bool) -> None:
        self._nominal = nominal
        i, j = np.indices(nominal.corners.shape[:2])
        self._sign = np.where(((i + j) % 2 == 0) == dark_first, 1.0, -1.0)
        self._fit = SaddlePointFit(nominal.side_px)

    def measure(self, image: PreparedImage, guess: NDArray[np.float64]) -> MeasuredCorners:
        """Corners near a guess (rows, cols, 2) px; NaN where the image shows none of that number.

        The surface must bend down along the diagonal of the dark checkers, by as much as around
        it, and be straight along both gridlines; the rings must show four checkers, and the edges
        to the neighbours be there.
        """
        found, hessian = self._fitted(image, guess, REFINE_REACH)
        return found.without(~self._in_sight(image, found.position, hessian).alike)

    def complete(
        self, image: PreparedImage, corners: MeasuredCorners, seen: NDArray[np.float64]
    ) -> MeasuredCorners:
        """Fill missing corners from the image, outwards from those that are known.

        seen (rows, cols, 2) px: where a detector saw them in this image, NaN where it did not.

        A corner is looked for where its neighbours along the gridlines put it, and taken only if
        there is a saddle of the right sign close by: nothing is invented where the grid is hidden.
        What is still missing between known neighbours on all sides is spoilt by a flaw of the
        print: a lesser likeness will do for it, or else it is the crossing of its gridlines, or
        predicted, if the pattern shows around the flaw.
        """
        corners = corners.copy()
        position = corners.position
        tried = np.zeros(position.shape[:2], dtype=bool)
        for _ in range(MAX_COMPLETION_ROUNDS):
            places = predicted_places(position)
            wanted = np.isnan(position[..., 0]) & np.isfinite(places[..., 0]) & ~tried
            if not wanted.any():
                break
            tried |= wanted
            found, hessian = self._looked_for(image, position, places, wanted)
            taken = wanted & self._in_sight(image, found.position, hessian).alike
            corners.take(taken, found)
            # A corner next to a newly found one has a better prediction than before.
            tried &= ~_beside(taken)
        if np.isnan(position).any():
            self._take_enclosed(image, corners, seen)
        self._take_spoilt(image, corners)
        return corners

    def repair_outliers(self, image: PreparedImage, corners: MeasuredCorners) -> MeasuredCorners:
        """The corners with those that a spot pulls aside measured as crossings of gridlines."""
        left = np.ones(corners.std.shape, dtype=bool)
        for _ in range(REPAIR_ROUNDS):
            # The worst of the neighbourhood first: it makes those around it look wrong.
            guess, off = off_neighbours(corners.position, self._nominal.side_px)
            pulled = left & _pulled(off)
            if not pulled.any():
                break
            corners = self._repaired_at(image, corners, guess, off, pulled)
            left &= ~pulled
        bent = ~corners.predicted & (off > MAX_SMOOTH_OFFSET_SIDES)
        if bent.any():
            corners = corners.copy()
            corners.std[bent] = np.maximum(corners.std[bent], BEND_ERROR_PX_PER_SIDE * off[bent])
        return corners

    def _repaired_at(
        self,
        image: PreparedImage,
        corners: MeasuredCorners,
        guess: NDArray[np.float64],
        off: NDArray[np.float64],
        pulled: NDArray[np.bool_],
    ) -> MeasuredCorners:
        side = self._nominal.side_px
        corners = corners.copy()
        position, std = corners.position, corners.std
        without = np.where(pulled[..., None], np.nan, position)
        around = self._around(image, without)
        crossing = around.crossings(image, guess, pulled)
        steps = around.row_step[pulled], around.col_step[pulled]
        rings = ring_evidence(image.smooth, position[pulled], *steps)[:, 0]
        clear = corners.modelled[pulled] & (std[pulled] < MAX_CLEAR_STD_SIDES * side)
        spoilt = ~(clear | (rings / around.amplitude[pulled] > MIN_WHOLE_RING_RATIO))
        away = np.linalg.norm(crossing - position[pulled], axis=1) / side
        left = np.linalg.norm(crossing - guess[pulled], axis=1) / side
        better, doubtful = pulled.copy(), pulled.copy()
        better[pulled] = spoilt & (away > MIN_CROSSING_OFFSET_SIDES) & (left < off[pulled])
        corners.put(better, crossing[better[pulled]], CROSSING_STD * side)
        # What cannot be measured otherwise stays, with half of what it is off as its deviation,
        # or gives way to where its neighbours have it.
        doubtful[pulled] = spoilt & ~(away <= MIN_CROSSING_OFFSET_SIDES) & ~better[pulled]
        std[doubtful] = np.maximum(std[doubtful], off[doubtful] * side / 2)
        given_up = doubtful & (off > MAX_DISPLACED_OFFSET_SIDES)
        corners.put(given_up, guess[given_up], std[given_up], predicted=True)
        return corners

    def without_rims(self, corners: MeasuredCorners) -> MeasuredCorners:
        """The corners less those beside missing ones that are not where the others predict them.

        The rim of what hides the gel makes saddle points with the edges that it crosses.
        """
        missing = np.isnan(corners.position[..., 0])
        if not missing.any() or missing.all():
            return corners
        moved = corners.position - self._nominal.corners
        off = np.linalg.norm(moved - predicted_places(moved), axis=-1) / self._nominal.side_px
        if np.isnan(off).all():
            return corners
        # On a ragged print all corners scatter.
        limit = max(MAX_RIM_OFFSET_SIDES, MAX_RIM_OFFSET_RATIO * float(np.nanmedian(off)))
        with np.errstate(invalid="ignore"):
            rim = _beside(missing) & (off > limit)
        return corners.without(rim)

    def without_strays(self, corners: MeasuredCorners) -> tuple[MeasuredCorners, int]:
        """The corners less those of another pattern that continues this one's, and how many.

        Also less those that have then no neighbour along a gridline, as nothing confirms them.
        """
        position = corners.position.copy()
        if not drop_stray_parts(position, self._nominal):
            return corners, 0
        known = ~np.isnan(position[..., 0])
        left = corners.without(~known | _alone(known))
        return left, left.missing - corners.missing

    def between(self, corners: MeasuredCorners, rows: tuple[float, float]) -> MeasuredCorners:
        """The corners that lie between two image rows at which the image is torn, px."""
        near = NEAR_TEAR * self._nominal.side_px
        with np.errstate(invalid="ignore"):
            beyond = (corners.position[..., 1] < rows[0] + near) | (
                corners.position[..., 1] > rows[1] - near
            )
        return corners.without(beyond) if beyond.any() else corners

    def is_bounded(self, image: PreparedImage, corners: NDArray[np.float64]) -> bool:
        """Whether a grid (rows, cols, 2) px, NaN where not known, ends where the pattern ends.

        A lattice shifted by two cells looks perfect but for this: beyond one side there are
        further corners.
        """
        row_step, col_step = local_steps(corners, self._nominal.row_step, self._nominal.col_step)
        steps = border_of(row_step), border_of(col_step)
        rings = ring_evidence(image.smooth, outside_corners(corners), *steps)
        inner = ring_evidence(image.smooth, border_of(corners), *steps)
        return _ends_everywhere(rings, inner, corners.shape[0], corners.shape[1])

    def _looked_for(
        self,
        image: PreparedImage,
        position: NDArray[np.float64],
        guess: NDArray[np.float64],
        wanted: NDArray[np.bool_],
    ) -> tuple[MeasuredCorners, NDArray[np.float64]]:
        """As `_fitted`, of the known corners, and near the guesses of those that are wanted."""
        return self._fitted(image, np.where(wanted[..., None], guess, position), COMPLETE_REACH)

    def _fitted(
        self, image: PreparedImage, start: NDArray[np.float64], reach: float
    ) -> tuple[MeasuredCorners, NDArray[np.float64]]:
        """Corners within so many sides of their starts (rows, cols, 2) px, hessians (n, 3)."""
        shape = start.shape[:2]
        found = self._fit.fit(image, start.reshape(-1, 2), reach * self._nominal.side_px)
        corners = MeasuredCorners(
            position=found.position.reshape(start.shape),
            std=found.std.reshape(shape),
            predicted=np.zeros(shape, dtype=bool),
            modelled=found.modelled.reshape(shape),
            pull=found.pull.reshape(*shape, 2, 4),
        )
        return corners, found.hessian

    def _in_sight(
        self, image: PreparedImage, position: NDArray[np.float64], hessian: NDArray[np.float64]
    ) -> _Likeness:
        """Whether each fitted saddle is that of a corner in sight with the number that it bears."""
        shape = position.shape[:2]
        row_step, col_step = local_steps(position, self._nominal.row_step, self._nominal.col_step)
        bends = np.empty((2, *shape))
        measure_bends(hessian, row_step, col_step, self._sign, bends)
        alike, similar = np.zeros((2, *shape), dtype=bool)
        if not np.isfinite(bends[0]).any():
            return _Likeness(alike, similar)
        flat = (step.reshape(-1, 2) for step in (position, row_step, col_step))
        rings = ring_evidence(image.smooth, *flat).reshape(*shape, -1)
        ring, quality = self._sign * rings[..., 0], rings[..., 1].copy()
        compare(bends, (ring, quality), (_around(bends[0]), _around(ring)), alike, similar)
        steps = row_step, col_step
        has_edges = find_edges(image.smooth, position, steps, self._sign, ring)
        return _Likeness(alike & has_edges, similar & has_edges)

    def _take_enclosed(
        self, image: PreparedImage, corners: MeasuredCorners, seen: NDArray[np.float64]
    ) -> None:
        """Add, in place, corners of a lesser likeness of which all neighbours are known, or all but
        one if the detector saw the corner and nothing is hidden.
        """
        position = corners.position
        missing, was_seen = np.isnan(position[..., 0]), np.isfinite(seen[..., 0])
        nothing_hidden = _few_in_each_place(~was_seen)
        places = np.where(was_seen[..., None], seen, predicted_places(position))
        for _ in range(2):
            wanted = missing & np.isfinite(places[..., 0])
            found, hessian = self._looked_for(image, position, places, wanted)
            similar = self._in_sight(image, found.position, hessian).similar
            sure = was_seen & nothing_hidden
            known = ~missing | (wanted & (similar | sure))
            while (lost := known & missing & (_unknown_beside(known) > sure)).any():
                known &= ~lost
            # A second time from where those that were found put the others.
            fitted = np.where(known[..., None], found.position, np.nan)
            places = np.where(was_seen[..., None], seen, predicted_places(fitted))
        taken = known & missing
        places = np.where(np.isnan(found.position), seen, found.position)
        std = np.fmax(found.std[taken], BETWEEN_STD * self._nominal.side_px)
        corners.put(taken, places[taken], std)

    def _take_spoilt(self, image: PreparedImage, corners: MeasuredCorners) -> None:
        """Add, in place, what flaws of the print between known corners leave of a corner."""
        position = corners.position
        hole = np.isnan(position[..., 0]) & _enclosed(np.isfinite(position[..., 0]))
        if not hole.any():
            return
        guess = place_between(position)
        around = self._around(image, position)
        rings = ring_evidence(
            image.smooth, guess[hole], around.row_step[hole], around.col_step[hole]
        )
        with np.errstate(invalid="ignore"):
            shows = rings[:, 0] / around.amplitude[hole] > WEAKEST_ENCLOSED
            shows &= rings[:, 1] > LEAST_ENCLOSED_QUALITY
        crossing = around.crossings(image, guess, hole)
        measured = np.isfinite(crossing[:, 0])
        taken = np.where(measured[:, None], crossing, guess[hole])
        spread = np.where(measured, CROSSING_STD, BETWEEN_STD) * self._nominal.side_px
        hole[hole] = shown = shows | measured
        corners.put(hole, taken[shown], spread[shown], ~measured[shown])

    def _around(self, image: PreparedImage, known: NDArray[np.float64]) -> _Surroundings:
        """What the known corners (rows, cols, 2) px say about each place in the grid."""
        steps = local_steps(known, self._nominal.row_step, self._nominal.col_step)
        flat = (array.reshape(-1, 2) for array in (known, *steps))
        rings = ring_evidence(image.smooth, *flat)[:, 0].reshape(self._sign.shape)
        return _Surroundings(*steps, self._sign * _around(self._sign * rings))


@kernel
def _ends_everywhere(
    outside: NDArray[np.float64], border: NDArray[np.float64], rows: int, cols: int
) -> bool:
    """Whether no side goes on for long, by rings (n, 4) in the order of `border_of`."""
    first = 0
    for length in (cols, cols, rows, rows):
        alike = run = longest = 0
        for k in range(first, first + length):
            # Beyond a corner lies one of the other parity.
            relative = -outside[k, 0] / border[k, 0]
            goes_on = relative > WEAKEST_RING and outside[k, 1] > LEAST_QUALITY
            run = run + 1 if goes_on else 0
            longest = max(longest, run)
            alike += goes_on
        if alike >= MIN_CONTINUED_SHARE * length or longest >= max(
            MIN_CONTINUED_RUN_SHARE * length, MIN_CONTINUED_RUN
        ):
            return False
        first += length
    return True


def _enclosed(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Corners between known neighbours along one gridline, with another on the other gridline."""
    up, down, left, right = known_beside(known)
    return np.asarray((up & down & (left | right)) | (left & right & (up | down)))


def _alone(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Known corners without a known neighbour along one of their gridlines."""
    up, down, left, right = known_beside(known)
    return np.asarray(known & ~((up | down) & (left | right)))


def _few_in_each_place(unseen: NDArray[np.bool_]) -> bool:
    """Whether a detector missed so few corners in each place that nothing but flaws hides them."""
    count = np.count_nonzero(unseen)
    if count <= MAX_FLAW_CORNERS:
        return True
    _, _, places, _ = cv2.connectedComponentsWithStats(unseen.astype(np.uint8), connectivity=8)
    return bool(places[1:, cv2.CC_STAT_AREA].max() <= MAX_FLAW_CORNERS)


def _unknown_beside(known: NDArray[np.bool_]) -> NDArray[np.int64]:
    """How many neighbours of each corner in the grid are not known."""
    return np.asarray(4 - np.sum(known_beside(known, outside=True), axis=0))


def _pulled(off: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Corners that are farther off their neighbours' curves than the 5 x 5 around them."""
    doubtful = off > MAX_SMOOTH_OFFSET_SIDES
    if not doubtful.any():
        return doubtful
    worst = cv2.dilate(off, np.ones((5, 5), dtype=np.uint8))
    return np.asarray(doubtful & (off >= worst) & (off > MAX_SMOOTH_OFFSET_RATIO * _around(off)))


def _beside(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What lies within two corners of the mask along a gridline."""
    near = np.zeros_like(mask)
    for reach in (1, 2):
        near[reach:] |= mask[:-reach]
        near[:-reach] |= mask[reach:]
        near[:, reach:] |= mask[:, :-reach]
        near[:, :-reach] |= mask[:, reach:]
    return near


def _around(strength: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median strength of the 5 x 5 corners around each one; light may differ across the view."""
    size = np.abs(strength)
    unknown = np.isnan(size)
    if unknown.any():
        size = np.where(unknown, np.nanmedian(size) if not unknown.all() else 1.0, size)
    return np.asarray(cv2.medianBlur(size.astype(np.float32), 5), dtype=np.float64)


@dataclass(frozen=True)
class MeasuredCorners:
    """position (rows, cols, 2) px, std (rows, cols) px per coordinate; NaN where not measured.

    predicted (rows, cols): the position is what the corners around leave room for, no more.
    modelled (rows, cols), pull (rows, cols, 2, 4): as of `SaddlePoints`.
    """

    position: NDArray[np.float64]
    std: NDArray[np.float64]
    predicted: NDArray[np.bool_]
    modelled: NDArray[np.bool_]
    pull: NDArray[np.float64]

    @property
    def missing(self) -> int:
        """Number of corners without a position."""
        return int(np.isnan(self.position[..., 0]).sum())

    @property
    def off_model(self) -> NDArray[np.bool_]:
        """Corners (rows, cols) to which no model was fitted though it was to others: of a flaw."""
        return np.asarray(~self.modelled & self.modelled.any())

    def without(self, lost: NDArray[np.bool_]) -> MeasuredCorners:
        """The corners less those of a mask (rows, cols)."""
        corners = self.copy()
        # What is found at its place otherwise was not fitted with these edges.
        corners.put(lost, np.nan, np.nan)
        return corners

    def none(self) -> MeasuredCorners:
        """A grid of the same size of which no corner is known."""
        return self.without(np.ones_like(self.predicted))

    def copy(self) -> MeasuredCorners:
        """The same corners, of which some may be set."""
        return MeasuredCorners(*(array.copy() for array in self._arrays))

    def take(self, where: NDArray[np.bool_], found: MeasuredCorners) -> None:
        """Set the corners of a mask (rows, cols) to those that were fitted."""
        for own, other in zip(self._arrays, found._arrays, strict=True):
            own[where] = other[where]

    def put(
        self,
        where: NDArray[np.bool_],
        position: float | NDArray[np.float64],
        std: float | NDArray[np.float64],
        predicted: bool | NDArray[np.bool_] = False,
    ) -> None:
        """Set the n corners of a mask (rows, cols) to positions (n, 2) that were not fitted."""
        self.position[where], self.std[where] = position, std
        self.predicted[where], self.modelled[where], self.pull[where] = predicted, False, 0.0

    @property
    def _arrays(self) -> tuple[NDArray[Any], ...]:
        return self.position, self.std, self.predicted, self.modelled, self.pull
