"""Stretches of a recording in which the gel stands still, whatever rests on it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.rigid_motion import local_mean

__all__ = ["largest_motion", "leading_frames", "motion_limit", "steady_stretches"]

# Nine neighbouring markers are averaged where the motion of one place is judged.
NEIGHBOURS = 9
# What noise may make of the largest of some hundred local means, in standard deviations.
DEVIATIONS = 5.0
# Motion below this is none, m: a tenth of the least that a load of interest makes.
LEAST_MOTION = 3e-6
# Standard deviation of normal noise per median of its absolute value.
MAD_TO_STD = 1.4826
# A reference sensor's reading changes by more than this while a load is put on: relative, and N.
FORCE_CHANGE, LEAST_FORCE_CHANGE = 0.02, 0.02


def motion_limit(position: NDArray[np.float64]) -> float:
    """Motion between two frames, as `largest_motion` has it, that noise does not explain, m.

    position (n, rows, cols, 3) m.  From differences of second order, which steady motion leaves
    at 0, over all frames: most of a recording may move.
    """
    if len(position) < 3:
        return LEAST_MOTION
    second = position[2:] - 2 * position[1:-1] + position[:-2]
    known = np.abs(second)[np.isfinite(second).all(axis=-1)]
    if not known.size:
        return LEAST_MOTION
    deviation = MAD_TO_STD * np.median(known, axis=0) / math.sqrt(6)
    noise = float(np.sqrt((deviation**2).sum())) * math.sqrt(2 / NEIGHBOURS)
    return max(LEAST_MOTION, DEVIATIONS * noise)


def largest_motion(before: NDArray[np.float64], after: NDArray[np.float64]) -> float:
    """Most that neighbouring markers moved together, m; positions (rows, cols, 3), NaN if unknown.

    Infinite where too few markers are known to tell.
    """
    moved = np.linalg.norm(local_mean(after - before), axis=-1)
    return float(np.nanmax(moved)) if np.isfinite(moved).any() else math.inf


def leading_frames(position: NDArray[np.float64], most: int) -> range:
    """The first frames, at most so many, up to where the gel begins to move."""
    limit = motion_limit(position)
    count = 1
    while count < min(len(position), most):
        if largest_motion(position[0], position[count]) > limit:
            break
        count += 1
    return range(count)


def steady_stretches(
    position: NDArray[np.float64], least: int, force: NDArray[np.float64] | None = None
) -> list[range]:
    """Ranges of at least so many frames in a row that all lie where the first of them does.

    force (n, 3) N: of a reference sensor at these frames; where it changes by more than 2 % and
    20 mN a stretch ends, too.
    """
    limit = motion_limit(position)
    found: list[range] = []
    start = 0
    for frame in range(1, len(position) + 1):
        if frame < len(position) and _goes_on(position, force, (start, frame), limit):
            continue
        if frame - start >= least:
            found.append(range(start, frame))
        start = frame
    return found


def _goes_on(
    position: NDArray[np.float64],
    force: NDArray[np.float64] | None,
    frames: tuple[int, int],
    limit: float,
) -> bool:
    first, this = frames
    if largest_motion(position[first], position[this]) > limit:
        return False
    if force is None:
        return True
    change = float(np.linalg.norm(force[this] - force[first]))
    return change <= FORCE_CHANGE * float(np.linalg.norm(force[first])) + LEAST_FORCE_CHANGE
