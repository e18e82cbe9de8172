"""Calibration by the gel's own pattern, over rigs that are not as their description says."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np
from optics_chain import CLEAN, Chain, Points, Shot, simulated, with_optics

from cmp_tactile_processing.calibration.gel.calibrate import calibrate_gel
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.library import load_sensor
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_simulation.hard_frames.changed_rig import changed_rig

REST_FRAMES = 10
NOISE_4 = replace(CLEAN, read_noise=4.0)
TOUCHES = ("press", "slide", "twist")
# Markers that moved less than this say nothing of a relative error, m.
MOVED_M = 1e-4
LARGEST_GAP_M = 1e-2


@dataclass(frozen=True)
class GelCalibration:
    """Mean error of the displacement before and after, um; after also as a share of it."""

    name: str
    before_um: float
    after_um: float
    share: float
    accepted: bool
    seconds: float


def gel_calibrations(count: int) -> Iterable[GelCalibration]:
    """So many changed rigs by 1 degree, 0.5 mm and 1 %, plain and behind a plate in turn."""
    bases = (load_sensor("sample_rig"), with_optics("prototype"))
    for seed in range(count):
        yield _calibrated(bases[seed % len(bases)], seed)


def _calibrated(described: SensorDescription, seed: int) -> GelCalibration:
    built = changed_rig(described, seed)
    name = f"{described.name}, change {seed}"
    rest = [simulated(built, "rest", NOISE_4, number) for number in range(REST_FRAMES)]
    touches = [simulated(built, kind) for kind in TOUCHES]
    began = perf_counter()
    try:
        outcome = calibrate_gel(described, [shot.frame.image for shot in rest])
    except CmpTactileError:
        nothing = float("nan")
        return GelCalibration(name, nothing, nothing, nothing, False, perf_counter() - began)
    seconds = perf_counter() - began
    # Tracked alike: what differs is the model.
    chain = Chain(built)
    # Before, rays miss each other by up to a millimetre; where in between the weighted point lies
    # is then a matter of the noise.
    middle = replace(described.triangulation, method="common_normal", max_ray_gap=LARGEST_GAP_M)
    before = _errors(chain, replace(described, triangulation=middle), rest, touches)
    after = _errors(chain, outcome.sensor or described, rest, touches)
    off, moved = after
    share = float(off[moved > MOVED_M].mean() / moved[moved > MOVED_M].mean())
    return GelCalibration(
        name,
        1e6 * float(before[0].mean()),
        1e6 * float(off.mean()),
        share,
        outcome.accepted,
        seconds,
    )


def _errors(
    chain: Chain, believed: SensorDescription, rest: list[Shot], touches: list[Shot]
) -> tuple[Points, Points]:
    """Errors of the displacement of markers, and how far they moved, m, with that model."""
    rig = StereoRig(believed)
    reference = Reference.average([chain.markers(shot, rig) for shot in rest], 1)
    off, moved = [], []
    for shot in touches:
        found = reference.surface(chain.markers(shot, rig)).displacement
        true = shot.truth.corners - rest[0].truth.corners
        seen = np.isfinite(found).all(axis=-1)
        off.append(np.linalg.norm((found - true)[seen], axis=-1))
        moved.append(np.linalg.norm(true[seen], axis=-1))
    return np.concatenate(off), np.concatenate(moved)
