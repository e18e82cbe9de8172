"""A reference force sensor beside the gel: lag of its force, drift of its zero, samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.calibration.gel_recording import (
    GelMotion,
    steady_stretches,
)
from cmp_tactile_bringup.calibration.loads import (
    TOUCHED,
    WrenchSeries,
    averaged,
    interpolated,
    loaded_stretches,
)
from cmp_tactile_processing.calibration.material.loads import LoadSample
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.surface.stillness import largest_motion, motion_limit

# The force is looked for so much earlier or later than the gel's motion, in such steps.
MAX_LAG_S = 1.0
LAG_STEP_S = 0.005
# A lag is believed if it leaves less than this share of what no lag leaves unexplained.
MAX_UNEXPLAINED_RATIO = 0.5
# Five values are fitted for each lag: fewer frames are explained by any of them.
MIN_LAG_FRAMES = 30
# Of the frames, this share needs a force.
MIN_KNOWN_SHARE = 0.5
# Not at rest yet: a filtered force takes so long after a load, s.
QUIET_AFTER_S = 0.6
# A drift of the zero over the recording that is worth a word, N.
MIN_DRIFT_N = 0.02


@dataclass(frozen=True)
class SensorSampling:
    """Which frames beside a reference sensor's topic become samples, and how well it is known.

    steady: mean of each stretch in which gel and force stand still, or else single frames.
    least_frames: of a stretch.  most: samples, evenly over the recording.
    std: of the reference sensor's force, N.
    """

    steady: bool = True
    least_frames: int = 4
    most: int = 60
    std: float = 0.01


def lag_s(motion: GelMotion, series: WrenchSeries, ahead_s: float) -> float:
    """How late the force comes after the gel's motion, s; 0 if no lag explains the motion better.

    ahead_s: as `at_frames` takes it; the lag is to be added to it.  The size of the motion is
    compared with the best sum of force components, a constant and a drift, so neither axes, signs,
    units nor the zero of the reference matter.
    """
    if len(motion.time_s) < MIN_LAG_FRAMES:
        return 0.0
    squares = (motion.displacement**2).sum(axis=-1).reshape(len(motion.displacement), -1)
    seen = np.isfinite(squares)
    mean = np.where(seen, squares, 0.0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    steps = round(MAX_LAG_S / LAG_STEP_S)
    lags = LAG_STEP_S * np.arange(-steps, steps + 1)
    forces = (interpolated(series, motion.stamp_ns, ahead_s + lag) for lag in lags)
    left = [_unexplained(motion.time_s, np.sqrt(mean), force) for force in forces]
    best = int(np.argmin(left))
    believed = left[best] < MAX_UNEXPLAINED_RATIO * left[steps]
    frame_s = float(np.median(np.diff(motion.time_s)))
    return float(lags[best]) if believed and abs(lags[best]) > frame_s / 2 else 0.0


def _unexplained(
    time_s: NDArray[np.float64], size: NDArray[np.float64], force: NDArray[np.float64]
) -> float:
    """Share of the variance of a motion (n,) that forces (n, 3), NaN if unknown, do not explain."""
    known = np.isfinite(force).all(axis=1)
    moved = size[known]
    if len(moved) < MIN_KNOWN_SHARE * len(size) or not moved.any():
        return np.inf
    A = np.column_stack([np.ones(len(moved)), time_s[known], force[known]])
    rest = moved - A @ np.linalg.lstsq(A, moved, rcond=None)[0]
    return float(rest @ rest) / float(moved @ moved)


@dataclass(frozen=True)
class ZeroedForce:
    """force (n, 3) N: less the zero of the reference at each frame.  std (3,) N: of that zero.

    drift (3,) N/s: of the zero; NaN unless the gel is at rest before and after a load.
    """

    force: NDArray[np.float64]
    std: NDArray[np.float64]
    drift: NDArray[np.float64]


def zeroed(motion: GelMotion, force: NDArray[np.float64]) -> ZeroedForce:
    """The force (n, 3) N less what the reference reads while nothing touches the gel.

    That is a straight line in time if the gel is at rest before and after a load, and otherwise the
    mean over `motion.rest`; nothing if the force is not known there.
    """
    limit = motion_limit(motion.displacement)
    rest = np.zeros(motion.displacement.shape[1:])
    moved = np.array([largest_motion(rest, item) for item in motion.displacement])
    known = np.asarray(np.isfinite(force).all(axis=1))
    loads = np.flatnonzero(moved > TOUCHED * limit)
    free = np.flatnonzero(known & (moved <= limit))
    last = loads[np.maximum(np.searchsorted(loads, free) - 1, 0)] if len(loads) else free
    since = motion.time_s[free] - motion.time_s[last]
    free = free[(since <= 0) | (since > QUIET_AFTER_S)]
    # The loads that came before each of the frames at rest: where it changes, a load lies between.
    before = np.searchsorted(loads, free)
    if len(np.unique(before)) < 2:
        first = [frame for frame in motion.rest if known[frame]]
        zero = force[first].mean(axis=0) if first else 0.0
        return ZeroedForce(force - zero, np.zeros(3), np.full(3, np.nan))
    A = np.column_stack([np.ones(len(force)), motion.time_s])
    line = np.linalg.lstsq(A[free], force[free], rcond=None)[0]
    without = force - A @ line
    off = [without[free[before == count]].mean(axis=0) for count in np.unique(before)]
    return ZeroedForce(without, np.sqrt(np.mean(np.square(off), axis=0)), line[1])


def drift_text(motion: GelMotion, zero: ZeroedForce) -> str:
    """What is to be said of the zero of the reference; empty if it stays."""
    if np.isnan(zero.drift).any():
        return (
            "the gel is not at rest after a load, so a drift of the reference force sensor "
            "is not seen; end the recording with the gel untouched"
        )
    change = np.abs(zero.drift).max() * motion.time_s[-1]
    if change < MIN_DRIFT_N:
        return ""
    drift = ", ".join(f"{value:+.3f}" for value in zero.drift)
    return (
        f"the zero of the reference force sensor drifts by {drift} N/s (x, y, z of the gel frame); "
        "this is subtracted"
    )


def samples_of_sensor(
    motion: GelMotion, zero: ZeroedForce, sampling: SensorSampling
) -> list[LoadSample]:
    """Samples beside a reference sensor's force on the gel at the frames.

    Frames without a force are left out.  Raises FrameSourceError where no frame is left.
    """
    force = zero.force
    known = np.asarray(np.isfinite(force).all(axis=1))
    shown = np.where(known[:, None, None, None], motion.displacement, np.nan)
    if sampling.steady:
        stretches = steady_stretches(shown, sampling.least_frames, force)
    else:
        stretches = [range(int(k), int(k) + 1) for k in np.flatnonzero(known)]
    loaded = loaded_stretches(motion, [item for item in stretches if known[item.start]])
    if not loaded:
        what = f"{sampling.least_frames} still frames in a row" if sampling.steady else "frame"
        msg = (
            f"{motion.source}: found no {what} in which the gel is pressed and the force known, "
            f"expected some{'; --every-frame takes frames in motion' if sampling.steady else ''}"
        )
        raise FrameSourceError(msg)
    every = max(1, -(-len(loaded) // sampling.most))
    return [_sensor_sample(motion, zero, item, sampling) for item in loaded[::every]]


def _sensor_sample(
    motion: GelMotion, zero: ZeroedForce, frames: range, sampling: SensorSampling
) -> LoadSample:
    displacement, status = averaged(motion, frames)
    part = zero.force[frames.start : frames.stop]
    half = len(part) // 2
    # A filtered force has not reached its value yet: it still changes while the gel is still.
    change = part[half:].mean(axis=0) - part[:half].mean(axis=0) if half else np.zeros(3)
    variance = part.var(axis=0) / len(part) + change**2 + zero.std**2 + sampling.std**2
    name = f"{motion.time_s[frames.start]:.2f} s"
    return LoadSample(displacement, status, part.mean(axis=0), np.sqrt(variance), name)
