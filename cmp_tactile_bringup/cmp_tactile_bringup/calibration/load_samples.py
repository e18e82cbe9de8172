"""Samples to calibrate the material: the gel's motion beside what is known of its load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.calibration.gel_recording import GelMotion
from cmp_tactile_bringup.calibration.known_loads import KnownLoad
from cmp_tactile_bringup.calibration.steady_frames import (
    largest_motion,
    motion_limit,
    steady_stretches,
)
from cmp_tactile_bringup.recordings.library import RecordingError
from cmp_tactile_processing.calibration.material.sample import LoadSample
from cmp_tactile_processing.measured.grid import Status

__all__ = ["SensorSampling", "averaged", "samples_of_sensor", "samples_of_weights", "zeroed"]

# So many times what noise alone explains the gel moves where something rests on it.
TOUCHED = 3.0


@dataclass(frozen=True)
class SensorSampling:
    """Which frames beside a reference sensor's topic become samples, and how well it is known.

    steady: mean of each stretch in which gel and force stand still, or else single frames.
    least_frames: of a stretch.  most: samples, evenly over the recording.
    std: of the reference sensor's force, N; torque_std: of its torque, N m; arm_std: of where its
    origin is, m.
    """

    steady: bool = True
    least_frames: int = 4
    most: int = 60
    std: float = 0.01
    torque_std: float = 2e-4
    arm_std: float = 5e-4


def averaged(
    motion: GelMotion, frames: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Mean displacement (rows, cols, 3) m over frames and its status.

    A marker that is measured in fewer than half of them is missing.
    """
    chosen = list(frames)
    measured = motion.status[chosen] == Status.MEASURED
    count = measured.sum(axis=0)
    total = np.where(measured[..., None], motion.displacement[chosen], 0.0).sum(axis=0)
    known = 2 * count >= len(chosen)
    mean = np.where(known[..., None], total / np.maximum(count, 1)[..., None], np.nan)
    return mean, np.where(known, Status.MEASURED, Status.MISSING).astype(np.uint8)


def samples_of_weights(
    loads: Sequence[KnownLoad], motions: Mapping[Path | None, GelMotion], least_frames: int
) -> list[LoadSample]:
    """A sample for each load; motions: by recording.

    A load without a time is the longest still press of its recording; of several such loads of
    one recording, each is the next still press.  Raises RecordingError where a load's time holds no
    frame, or where the presses are none or not as many as the loads.
    """
    untimed: dict[Path | None, list[KnownLoad]] = {}
    for load in loads:
        if load.time_s is None:
            untimed.setdefault(load.recording, []).append(load)
    presses = {
        recording: iter(_presses(motions[recording], own, least_frames))
        for recording, own in untimed.items()
    }
    samples = []
    for load in loads:
        motion = motions[load.recording]
        frames = _timed(load, motion) if load.time_s else next(presses[load.recording])
        displacement, status = averaged(motion, frames)
        samples.append(LoadSample(displacement, status, load.force, load.std, name=load.name))
    return samples


def _timed(load: KnownLoad, motion: GelMotion) -> Sequence[int]:
    begin, end = load.time_s or (0.0, 0.0)
    chosen = np.flatnonzero((motion.time_s >= begin) & (motion.time_s <= end))
    if not chosen.size:
        msg = (
            f"{motion.source}: {load.name}: time: found no frame from {begin:g} to {end:g} s, "
            f"expected some within its {motion.time_s[-1]:.2f} s"
        )
        raise RecordingError(msg)
    return [int(item) for item in chosen]


def _presses(motion: GelMotion, loads: Sequence[KnownLoad], least_frames: int) -> list[range]:
    """The still press of each of the loads, which have no times."""
    found = _loaded(motion, steady_stretches(motion.displacement, least_frames))
    if len(loads) == 1 and found:
        return [max(found, key=len)]
    if len(found) == len(loads):
        return found
    names = ", ".join(load.name for load in loads)
    when = ", ".join(
        f"{motion.time_s[item[0]]:.2f} to {motion.time_s[item[-1]]:.2f} s" for item in found
    )
    msg = (
        f"{motion.source}: {names}: found the gel pressed and still for {least_frames} frames or "
        f"more {len(found)} times ({when or 'never'}), expected {len(loads)}; `time` of a load "
        "tells its frames"
    )
    raise RecordingError(msg)


def _loaded(motion: GelMotion, stretches: Sequence[range]) -> list[range]:
    """Those in which something rests on the gel."""
    limit = TOUCHED * motion_limit(motion.displacement)
    rest = np.zeros(motion.displacement.shape[1:])
    return [item for item in stretches if largest_motion(rest, averaged(motion, item)[0]) > limit]


def zeroed(wrench: NDArray[np.float64], rest: Sequence[int]) -> NDArray[np.float64]:
    """The wrench (n, 6) less what it reads in the frames at rest, where that is known."""
    known = [frame for frame in rest if np.isfinite(wrench[frame, :3]).all()]
    return wrench - wrench[known].mean(axis=0) if known else wrench


def samples_of_sensor(
    motion: GelMotion, wrench: NDArray[np.float64], sampling: SensorSampling
) -> list[LoadSample]:
    """Samples beside a reference sensor's wrench at the frames, (n, 6) N and N m on the gel.

    NaN where it is not known: such frames are left out.  What it reads in the frames at rest, from
    which the gel's motion is counted, is its zero.  Raises RecordingError where no frame is left.
    """
    wrench = zeroed(wrench, motion.rest)
    known = np.asarray(np.isfinite(wrench[:, :3]).all(axis=1))
    shown = np.where(known[:, None, None, None], motion.displacement, np.nan)
    if sampling.steady:
        stretches = steady_stretches(shown, sampling.least_frames, wrench[:, :3])
    else:
        stretches = [range(int(k), int(k) + 1) for k in np.flatnonzero(known)]
    loaded = _loaded(motion, [item for item in stretches if known[item.start]])
    if not loaded:
        what = f"{sampling.least_frames} still frames in a row" if sampling.steady else "frame"
        msg = (
            f"{motion.source}: found no {what} in which the gel is pressed and the force known, "
            "expected some"
        )
        raise RecordingError(msg)
    every = max(1, -(-len(loaded) // sampling.most))
    return [_sensor_sample(motion, wrench, item, sampling) for item in loaded[::every]]


def _sensor_sample(
    motion: GelMotion, wrench: NDArray[np.float64], frames: range, sampling: SensorSampling
) -> LoadSample:
    displacement, status = averaged(motion, frames)
    part = wrench[frames.start : frames.stop]
    mean, scatter = part.mean(axis=0), part.var(axis=0) / len(part)
    arm = sampling.arm_std * float(np.linalg.norm(mean[:3]))
    std = np.sqrt(scatter[:3] + sampling.std**2)
    torque_std = np.sqrt(scatter[3:] + sampling.torque_std**2 + arm**2)
    begin = float(motion.time_s[frames.start])
    return LoadSample(
        displacement,
        status,
        mean[:3],
        std,
        mean[3:],
        torque_std,
        name=f"{begin:.2f} s",
    )
