"""How far the force on the gel is from the true one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.report.results import DemoResults
from cmp_tactile_processing.force.advice import ADVICE, flag_names, single_flags

__all__ = ["BAND", "COMPONENTS", "ForceEvaluation", "evaluate_force"]

COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
# Standard deviations to either side of a value within which 95 % of the truth would lie.
BAND = 2.0


@dataclass(frozen=True)
class ForceEvaluation:
    """Errors over all frames that came through, NaN where none did.

    wrench_rms (6,): of each component's error, N and N m, about the gel frame's origin.
    wrench_peak (6,): largest true size of each component in the recording.
    wrench_inside (6,): share of the frames whose true value is within BAND standard deviations of
    the measured one, of those that came with a deviation; wrench_told (6,): how many did.
    area_rms, area_peak: as wrench_rms and wrench_peak, of the contact area, m^2.
    flagged: frames in which each flag was set, for those that were.
    """

    wrench_rms: NDArray[np.float64]
    wrench_peak: NDArray[np.float64]
    wrench_inside: NDArray[np.float64]
    wrench_told: NDArray[np.intp]
    area_rms: float
    area_peak: float
    flagged: Mapping[str, int]

    @property
    def normal_share(self) -> float:
        """RMS error of the normal force over its largest size."""
        return float(self.wrench_rms[2] / self.wrench_peak[2])


def evaluate_force(results: DemoResults) -> ForceEvaluation:
    """Compare wrench and contact area of every frame with the truth."""
    truth = results.recording.truth
    frames = np.array([frame.index for frame in results.frames], np.intp)
    wrench = np.array([frame.force.wrench for frame in results.frames]).reshape(-1, 6)
    std = np.array([frame.force.wrench_std for frame in results.frames]).reshape(-1, 6)
    area = np.array([frame.force.contact_area for frame in results.frames])
    told = np.isfinite(wrench) & (std > 0)
    inside = told & (np.abs(wrench - truth.wrench[frames]) <= BAND * std)
    count = told.sum(axis=0)
    return ForceEvaluation(
        wrench_rms=_root_mean_square(wrench - truth.wrench[frames]),
        wrench_peak=np.abs(truth.wrench).max(axis=0),
        wrench_inside=np.where(count > 0, inside.sum(axis=0) / np.maximum(count, 1), np.nan),
        wrench_told=count,
        area_rms=float(_root_mean_square(area - truth.contact_area[frames])),
        area_peak=float(truth.contact_area.max()),
        flagged=_flagged(results),
    )


def _flagged(results: DemoResults) -> dict[str, int]:
    counts = dict.fromkeys(ADVICE, 0)
    for frame in results.frames:
        for flag in single_flags(frame.force.flags):
            counts[flag] += 1
    return {flag_names(flag): count for flag, count in counts.items() if count}


def _root_mean_square(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Over the first axis; an error that is not known makes the whole not known."""
    if not len(errors):
        return np.full(errors.shape[1:], np.nan)
    return np.asarray(np.sqrt((errors**2).mean(axis=0)))
