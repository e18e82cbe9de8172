"""Corners on flaws of the print, found again by what their surroundings look like at rest.

Where ink is missing or edges are ragged, the model of a corner has a different error in each frame,
and a displacement contains the errors of both frames.  The flaw itself moves with the gel: the
picture of a corner at rest, shifted until it fits a frame, gives its displacement (Lucas and
Kanade; Baker and Matthews 2004).  Its middle is where the corner would be on a sound print: what
lies beside it is displaced by something else where the gel stretches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_processing.image.prepared import MIN_SMOOTHING_PX, PreparedImage, sample
from cmp_tactile_processing.tracking.corners.neighbours import predicted_places

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Points of a picture along a side, and how far they reach from the corner, in checkers.
POINTS, REACH = 13, 0.5
# Weight of the points that are farthest along a gridline; 1 at the corner.
WEIGHT_AT_REACH = 0.6
# The picture's slopes are differences between places so many checkers to both sides.
SLOPE_STEP = 0.03
ROUNDS, ARRIVED_PX = 4, 0.01
# How often what does not fit is tried again, from where it came to rest or its neighbours have it.
ATTEMPTS = 3
# A fit farther from the model's corner than this, in checkers, is rejected, and one with less than
# this share of the picture's contrast.
FARTHEST, LEAST_CONTRAST = 0.15, 0.2
# What the best shift may leave: so many times the noise, and a share of the fitted contrast.
NOISES_LEFT, SHARE_LEFT = 3.0, 0.06
# A print of which no more pictures fit than this share of those in sight is another one.
LEAST_FITTING = 0.5
# Error of a shift without noise, px per coordinate (measured on the pairs of flawed prints of
# benchmarks/hard_frames).
BIAS_PX = 0.015


def _lattice() -> tuple[Array, Array]:
    """Points (k, 2) of a picture in checkers from the corner, and their weights (k,)."""
    along = np.linspace(-REACH, REACH, POINTS)
    points = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    return points, 1 - (1 - WEIGHT_AT_REACH) * (points**2).sum(axis=1) / REACH**2


LATTICE, WEIGHT = _lattice()


@dataclass(frozen=True)
class FlawedCorners:
    """The pictures of the flawed corners of a print at rest.

    known (rows, cols): which corners have one, n in all.  basis (n, 4, k): how grey levels of the
    picture change by a shift along both gridlines, contrast, and brightness; solution (n, 4, k): of
    these four, from the grey levels of a frame.  gain (n,): deviation of the corner, px per
    coordinate, for one grey level of noise.  aside (n, 2): from the corner as the model measures it
    to the picture's middle, in steps along the row and the column.
    """

    known: Mask
    basis: Single
    solution: Single
    gain: Array
    aside: Array

    @classmethod
    def at_rest(
        cls, image: Single, smoothing_px: float, corners: Array, sound: Array, flawed: Mask
    ) -> FlawedCorners:
        """Of a smoothed image (H, W); corners (rows, cols, 2) px in it, of which some are flawed.

        sound (rows, cols, 2) px: where a sound print would show them.  Corners without neighbours,
        or too near the image's edge, get no picture.
        """
        measured, steps = _steps(corners), _steps(sound)
        known = flawed & np.isfinite(corners).all(axis=2)
        for each in (measured, steps):
            known &= np.isfinite(each).all(axis=(2, 3))
            known[known] = np.abs(np.linalg.det(each[known])) > 0
        place, way = sound[known], steps[known]
        aside = np.linalg.solve(measured[known], (place - corners[known])[..., None])[..., 0]
        picture = pictures(image, place, way, LATTICE)
        slopes = []
        for along in range(2):
            step = SLOPE_STEP * way[:, :, along]
            ahead, back = (pictures(image, at, way, LATTICE) for at in (place + step, place - step))
            slopes.append((ahead - back) / (2 * SLOPE_STEP))
        basis = np.stack([*slopes, picture, np.ones_like(picture)], axis=1, dtype=np.float64)
        weighted = basis * WEIGHT
        normal = weighted @ basis.swapaxes(1, 2)
        whole = np.isfinite(normal).all(axis=(1, 2))
        whole[whole] = np.linalg.matrix_rank(normal[whole], hermitian=True) == normal.shape[1]
        known[known] = whole
        solution = np.linalg.solve(normal[whole], weighted[whole])
        gain = _gains(max(smoothing_px, MIN_SMOOTHING_PX), way[whole], solution[:, :2])
        basis, solution = basis[whole].astype(np.float32), solution.astype(np.float32)
        return cls(known, basis, solution, gain, aside[whole])

    def measured(
        self, image: PreparedImage, corners: Array, std: Array, predicted: Mask
    ) -> tuple[Array, Array, Mask]:
        """Corners (rows, cols, 2) px and their deviations (rows, cols) px in a frame, with those
        whose pictures fit, and which these are (rows, cols).

        The others are where the model has them, less what the flaw moved them by at rest, with what
        they are off their neighbours as their least deviation; predicted (rows, cols): not by the
        model, but between their neighbours.  All stay as they are where few pictures fit: the print
        is another one.
        """
        straight, aside = corners.copy(), np.where(predicted[self.known, None], 0.0, self.aside)
        moved = (_steps(corners)[self.known] @ aside[..., None])[..., 0]
        # Where no neighbour is known the corner stays.
        straight[self.known] += np.nan_to_num(moved)
        std, found, start = std.copy(), np.zeros_like(self.known), straight
        wanted = left = self.known & np.isfinite(std)
        for _ in range(ATTEMPTS):
            place, deviation, fits = self._fitted(image, start, left)
            straight[fits], std[fits] = place[fits], deviation[fits]
            found |= fits
            if np.count_nonzero(found) < LEAST_FITTING * np.count_nonzero(wanted):
                return corners, std, np.zeros_like(found)
            left = wanted & ~found
            if not left.any():
                return straight, std, found
            # The model went astray there or beside, or something covers the print.
            guess, start = predicted_places(straight), straight.copy()
            start[left] = np.where(np.isnan(place), guess, place)[left]
        off = np.linalg.norm(straight - guess, axis=-1)
        std[left] = np.fmax(std, off)[left]
        return straight, std, found

    def _fitted(
        self, image: PreparedImage, corners: Array, wanted: Mask
    ) -> tuple[Array, Array, Mask]:
        """Where wanted pictures (rows, cols) come to rest, (rows, cols, 2) px, their deviations
        (rows, cols) px, and which of them fit there.

        NaN for those that come to rest far from their corners (rows, cols, 2) px, and where nothing
        is wanted.
        """
        ways = _steps(corners)
        wanted = wanted & np.isfinite(ways).all(axis=(2, 3)) & np.isfinite(corners).all(axis=2)
        which = wanted[self.known]
        place, steps = corners[wanted], ways[wanted]
        solution, basis = self.solution[which], self.basis[which]
        left, contrast = np.zeros((2, len(place)))
        for _ in range(ROUNDS):
            picture = pictures(image.smooth, place, steps, LATTICE)
            found = solution @ picture[:, :, None]
            rest = picture - (found.swapaxes(1, 2) @ basis)[:, 0]
            left = np.sqrt(np.mean(rest**2, axis=1))
            contrast = np.asarray(found[:, 2, 0], np.float64)
            shift = (steps @ (found[:, :2] / found[:, 2:3]))[..., 0]
            place -= shift
            if not (np.abs(shift) > ARRIVED_PX).any():
                break
        side = np.sqrt(np.abs(np.linalg.det(steps)))
        near = np.linalg.norm(place - corners[wanted], axis=1) < FARTHEST * side
        near &= contrast > LEAST_CONTRAST
        limit = NOISES_LEFT * image.smooth_noise + SHARE_LEFT * contrast * basis[:, 2].std(axis=1)
        found_places, deviation = np.full_like(corners, np.nan), np.full(self.known.shape, np.nan)
        found_places[wanted] = np.where(near[:, None], place, np.nan)
        deviation[wanted] = np.hypot(image.noise * self.gain[which] / contrast, BIAS_PX)
        fits = wanted.copy()
        fits[wanted] = near & (left < limit)
        return found_places, deviation, fits


def _steps(corners: Array) -> Array:
    """Ways (rows, cols, 2, 2) px to the next corner of the row and of the column, as columns.

    The mean over both sides, or that on the side where the neighbour is known.
    """
    ways = []
    for axis in (1, 0):
        way = np.diff(corners, axis=axis)
        end = np.full_like(corners.take([0], axis), np.nan)
        ahead, behind = (np.concatenate(both, axis) for both in ((way, end), (end, way)))
        mean = (ahead + behind) / 2
        ways.append(np.where(np.isnan(mean), np.fmax(ahead, behind), mean))
    return np.stack(ways, axis=-1)


def _gains(smoothing: float, steps: Array, solution: Array) -> Array:
    """Deviations (n,) of corners, px per coordinate, for one grey level of noise.

    steps (n, 2, 2) px; solution (n, 2, k): shifts by grey levels of the smoothed image, whose noise
    is much the same in neighbouring points.
    """
    if not len(steps):
        return np.zeros(0)
    side = float(np.sqrt(np.abs(np.linalg.det(steps)).mean()))
    apart = side * np.linalg.norm(LATTICE[:, None] - LATTICE, axis=-1)
    alike = np.exp(-((apart / (2 * smoothing)) ** 2)) / (4 * np.pi * smoothing**2)
    moved = steps @ solution
    variance = np.einsum("nxk,kl,nxl->n", moved, alike, moved, optimize=True)
    # Of both coordinates together.
    return np.asarray(np.sqrt(variance / 2))


@kernel
def pictures(image: Single, place: Array, steps: Array, lattice: Array) -> Single:
    """Grey levels (n, k) of a smoothed image at points (k, 2) of a lattice around places (n, 2).

    steps (n, 2, 2) px: per unit of the lattice.  NaN outside of the image.
    """
    found = np.empty((len(place), len(lattice)), np.float32)
    for n in range(len(place)):
        for k in range(len(lattice)):
            u, v = lattice[k, 0], lattice[k, 1]
            x = place[n, 0] + steps[n, 0, 0] * u + steps[n, 0, 1] * v
            y = place[n, 1] + steps[n, 1, 0] * u + steps[n, 1, 1] * v
            found[n, k] = sample(image, x, y)
    return found
