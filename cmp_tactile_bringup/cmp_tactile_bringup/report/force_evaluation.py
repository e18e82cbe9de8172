"""How far the force on the gel is from the true one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.report.results import DemoResults

__all__ = ["COMPONENTS", "ForceEvaluation", "evaluate_force"]

COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")


@dataclass(frozen=True)
class ForceEvaluation:
    """Errors over all frames that came through, NaN where none did.

    wrench_rms (6,): of each component's error, N and N m, about the gel frame's origin.
    wrench_peak (6,): largest true size of each component in the recording.
    area_rms, area_peak: the same of the contact area, m^2.
    """

    wrench_rms: NDArray[np.float64]
    wrench_peak: NDArray[np.float64]
    area_rms: float
    area_peak: float

    @property
    def normal_share(self) -> float:
        """RMS error of the normal force over its largest size."""
        return float(self.wrench_rms[2] / self.wrench_peak[2])


def evaluate_force(results: DemoResults) -> ForceEvaluation:
    """Compare wrench and contact area of every frame with the truth."""
    truth = results.recording.truth
    frames = np.array([frame.index for frame in results.frames], np.intp)
    wrench = np.array([frame.force.wrench for frame in results.frames]).reshape(-1, 6)
    area = np.array([frame.force.contact_area for frame in results.frames])
    return ForceEvaluation(
        wrench_rms=_root_mean_square(wrench - truth.wrench[frames]),
        wrench_peak=np.abs(truth.wrench).max(axis=0),
        area_rms=float(_root_mean_square(area - truth.contact_area[frames])),
        area_peak=float(truth.contact_area.max()),
    )


def _root_mean_square(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Over the first axis; an error that is not known makes the whole not known."""
    if not len(errors):
        return np.full(errors.shape[1:], np.nan)
    return np.asarray(np.sqrt((errors**2).mean(axis=0)))
