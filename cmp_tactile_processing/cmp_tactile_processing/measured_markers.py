"""Measured markers: sub-pixel corners of a numbered grid, checked against the image around them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.corner_evidence import edge_evidence, ring_evidence
from cmp_tactile_processing.edge_crossing import edge_crossings
from cmp_tactile_processing.local_lattice import (
    border_of,
    local_steps,
    outside_corners,
    place_between,
    predicted_places,
)
from cmp_tactile_processing.nominal_grid import NominalGrid
from cmp_tactile_processing.prepared_image import PreparedImage
from cmp_tactile_processing.saddle_point import SaddlePointFit

__all__ = ["MeasuredCorners", "MeasuredMarkers"]

# Shares of the local checker side: how far the fit may move a corner, and how far a corner may lie
# from where its neighbours predict it.
REFINE_REACH, COMPLETE_REACH = 0.35, 0.25
# Where the rim of something that hides the gel crosses a gridline, there is a saddle too.  It is
# weaker or stronger than those around it, or its contours run askew of the gridlines.  Of corners
# in sight, 99.9 % stay within 0.73 to 1.2 of their neighbours' strength, even at noise of 16 grey
# levels or on a worn print, and 99.9 % below a skew of 0.2 (0.48 on the worn print).
WEAKEST_SADDLE, STRONGEST_SADDLE = 0.65, 1.4
LARGEST_SKEW = 0.4
# The rings reach farther than the fit: least share of their variance that is a corner's, and their
# strength relative to the corners around.
LEAST_QUALITY = 0.45
WEAKEST_RING, STRONGEST_RING = 0.6, 1.5
# An edge to a neighbour differs in grey by this share of the corner's amplitude.
LEAST_EDGE = 0.4
# A corner within the grid that a spot spoils: what is left of its rings.
LEAST_SPOILT_QUALITY, WEAKEST_SPOILT = 0.25, 0.3
# A corner's place between its neighbours, where the spot lets nothing else be measured, is off by
# about this share of a side on a strongly deformed gel.
SPOILT_STD, CROSSING_STD = 0.02, 0.008
MAX_ROUNDS = 8


@dataclass(frozen=True)
class MeasuredCorners:
    """position (rows, cols, 2) px, std (rows, cols) px per coordinate; NaN where not measured.

    predicted (rows, cols): the position is what the corners around leave room for, no more.
    """

    position: NDArray[np.float64]
    std: NDArray[np.float64]
    predicted: NDArray[np.bool_]

    @property
    def missing(self) -> int:
        """Number of corners without a position."""
        return int(np.isnan(self.position[..., 0]).sum())


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
        shape = guess.shape[:2]
        reach = REFINE_REACH * self._nominal.side_px
        saddles = self._fit.fit(image, guess.reshape(-1, 2), reach)
        position = saddles.position.reshape(guess.shape)
        good = self._in_sight(image, position, saddles.hessian)
        position = np.where(good[..., None], position, np.nan)
        std = np.where(good, saddles.std.reshape(shape), np.nan)
        return MeasuredCorners(position, std, np.zeros(shape, dtype=bool))

    def complete(self, image: PreparedImage, corners: MeasuredCorners) -> MeasuredCorners:
        """Fill missing corners from the image, outwards from those that are known.

        A corner is looked for where its neighbours along the gridlines put it, and taken only if
        there is a saddle of the right sign close by: nothing is invented where the grid is hidden.
        What is still missing between known neighbours on both sides is spoilt by a spot: it is the
        crossing of its gridlines, or else predicted, if the pattern shows around the spot.
        """
        position, std = corners.position.copy(), corners.std.copy()
        tried = np.zeros(position.shape[:2], dtype=bool)
        for _ in range(MAX_ROUNDS):
            guess = predicted_places(position)
            wanted = np.isnan(position[..., 0]) & np.isfinite(guess[..., 0]) & ~tried
            if not wanted.any():
                break
            tried |= wanted
            found = self._looked_for(image, position, guess, wanted)
            taken = wanted & np.isfinite(found.position[..., 0])
            position[taken], std[taken] = found.position[taken], found.std[taken]
            # A corner next to a newly found one has a better prediction than before.
            tried &= ~_beside(taken)
        return self._spoilt(image, position, std)

    def is_bounded(self, image: PreparedImage, corners: NDArray[np.float64]) -> bool:
        """Whether a complete grid (rows, cols, 2) px ends where the pattern ends.

        A lattice shifted by two cells looks perfect but for this: beyond one side there are
        further corners.
        """
        row_step, col_step = local_steps(corners, self._nominal.row_step, self._nominal.col_step)
        steps = border_of(row_step), border_of(col_step)
        rings = ring_evidence(image.smooth, outside_corners(corners), *steps)
        inner = ring_evidence(image.smooth, border_of(corners), *steps)
        # Beyond a corner lies one of the other parity.
        with np.errstate(invalid="ignore"):
            alike = (-rings[:, 0] / inner[:, 0] > WEAKEST_RING) & (rings[:, 1] > LEAST_QUALITY)
        rows, cols = corners.shape[:2]
        sides = np.split(alike, [cols, 2 * cols, 2 * cols + rows])
        return all(side.mean() < 0.5 for side in sides)

    def _looked_for(
        self,
        image: PreparedImage,
        position: NDArray[np.float64],
        guess: NDArray[np.float64],
        wanted: NDArray[np.bool_],
    ) -> MeasuredCorners:
        reach = COMPLETE_REACH * self._nominal.side_px
        saddles = self._fit.fit(image, guess[wanted], reach)
        candidate = position.copy()
        candidate[wanted] = saddles.position
        return self.measure(image, candidate)

    def _in_sight(
        self, image: PreparedImage, position: NDArray[np.float64], hessian: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Whether each fitted saddle is that of a corner in sight with the number that it bears."""
        shape = position.shape[:2]
        row_step, col_step = local_steps(position, self._nominal.row_step, self._nominal.col_step)
        flat_row, flat_col = row_step.reshape(-1, 2), col_step.reshape(-1, 2)
        bend = _curvature(hessian, flat_row - flat_col) - _curvature(hessian, flat_row + flat_col)
        strength = self._sign * bend.reshape(shape)
        if not np.isfinite(strength).any():
            return np.zeros(shape, dtype=bool)
        along = np.maximum(
            np.abs(_curvature(hessian, flat_row)), np.abs(_curvature(hessian, flat_col))
        ).reshape(shape)
        rings = ring_evidence(image.smooth, position.reshape(-1, 2), flat_row, flat_col)
        ring = self._sign * rings[:, 0].reshape(shape)
        with np.errstate(invalid="ignore"):
            relative, relative_ring = strength / _around(strength), ring / _around(ring)
            good = (relative > WEAKEST_SADDLE) & (relative < STRONGEST_SADDLE)
            good &= (relative_ring > WEAKEST_RING) & (relative_ring < STRONGEST_RING)
            good &= rings[:, 1].reshape(shape) > LEAST_QUALITY
            good &= along < LARGEST_SKEW * strength
        return good & self._has_edges(image, position, ring, row_step, col_step)

    def _has_edges(
        self,
        image: PreparedImage,
        position: NDArray[np.float64],
        amplitude: NDArray[np.float64],
        row_step: NDArray[np.float64],
        col_step: NDArray[np.float64],
    ) -> NDArray[np.bool_]:
        """Whether at least half of the edges to known neighbours, and one, are there."""
        known, seen = np.zeros(amplitude.shape), np.zeros(amplitude.shape)
        for here, there, across in (
            (np.s_[:-1], np.s_[1:], col_step),
            (np.s_[:, :-1], np.s_[:, 1:], row_step),
        ):
            start, end = position[here], position[there]
            edge = edge_evidence(
                image.smooth,
                start.reshape(-1, 2),
                end.reshape(-1, 2),
                across[here].reshape(-1, 2),
            )[:, 1].reshape(start.shape[:2])
            # Beyond an even corner the checker at (+, +) is dark.
            step = -self._sign[here] * edge
            there_is = np.isfinite(edge)
            is_edge = there_is & (step > LEAST_EDGE * (amplitude[here] + amplitude[there]) / 2)
            for end_points in (here, there):
                known[end_points] += there_is
                seen[end_points] += is_edge
        return np.asarray((seen >= 1) & (2 * seen >= known))

    def _spoilt(
        self, image: PreparedImage, position: NDArray[np.float64], std: NDArray[np.float64]
    ) -> MeasuredCorners:
        predicted = np.zeros(std.shape, dtype=bool)
        hole = np.isnan(position[..., 0]) & _enclosed(np.isfinite(position[..., 0]))
        if not hole.any():
            return MeasuredCorners(position, std, predicted)
        guess = place_between(position)
        row_step, col_step = local_steps(position, self._nominal.row_step, self._nominal.col_step)
        steps = row_step[hole], col_step[hole]
        usual = self._usual_amplitude(image, position, row_step, col_step)[hole]
        rings = ring_evidence(image.smooth, guess[hole], *steps)
        with np.errstate(invalid="ignore"):
            shows = (rings[:, 0] / usual > WEAKEST_SPOILT) & (rings[:, 1] > LEAST_SPOILT_QUALITY)
        crossing = edge_crossings(image.smooth, guess[hole], *steps, usual)
        measured = np.isfinite(crossing[:, 0])
        taken = np.where(measured[:, None], crossing, guess[hole])
        side = self._nominal.side_px
        spread = np.where(measured, CROSSING_STD, SPOILT_STD) * side
        shown = shows | measured
        position[hole] = np.where(shown[:, None], taken, np.nan)
        std[hole] = np.where(shown, spread, np.nan)
        predicted[hole] = shown & ~measured
        return MeasuredCorners(position, std, predicted)

    def _usual_amplitude(
        self,
        image: PreparedImage,
        position: NDArray[np.float64],
        row_step: NDArray[np.float64],
        col_step: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Amplitude (rows, cols) of a whole corner at each place, with its sign."""
        rings = ring_evidence(
            image.smooth,
            position.reshape(-1, 2),
            row_step.reshape(-1, 2),
            col_step.reshape(-1, 2),
        )
        return self._sign * _around(self._sign * rings[:, 0].reshape(self._sign.shape))


def _enclosed(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Corners that have a known neighbour on either side along both gridlines.

    Along the grid's border one gridline is enough, with the known neighbour inwards.
    """
    padded = np.pad(known, 1)
    up, down = padded[:-2, 1:-1], padded[2:, 1:-1]
    left, right = padded[1:-1, :-2], padded[1:-1, 2:]
    border = np.ones_like(known)
    border[1:-1, 1:-1] = False
    along, across = up & down, left & right
    some = (up | down) & across | (left | right) & along
    return np.asarray((along & across) | (border & some))


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


def _curvature(hessian: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y = direction[:, 0], direction[:, 1]
    bend = hessian[:, 0] * x * x + 2 * hessian[:, 1] * x * y + hessian[:, 2] * y * y
    return np.asarray(bend / (x * x + y * y))
