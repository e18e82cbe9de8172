"""How the gel at rest has drifted away from the reference: the mount, the print, the gel itself."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.rigid_motion import fit_motion, largest_local_mean
from cmp_tactile_processing.sensor.parameters import Parameters, parameter
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.surface.stillness import FramesJudged, RestParameters, rest_shape

__all__ = ["Drift", "DriftMonitor", "DriftParameters"]

NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class DriftParameters(Parameters, section="drift"):
    """What drift of the gel at rest is followed and told."""

    drift_time: float = parameter(
        10.0, "time constant over which drift at rest is averaged", unit="s", within=(0.0, 3600.0)
    )
    drift_limit: float = parameter(
        15e-6,
        "drift of the gel at rest since the reference, as a whole or of neighbouring markers, "
        "above which it is warned of",
        unit="m",
        within=(1e-7, 1e-2),
    )


@dataclass(frozen=True)
class Drift:
    """Drift of the gel at rest since the reference, low-passed.

    shift: of the whole, m; turn: of the whole, rad; shape: most that neighbouring markers moved
    together beyond that, m; largest: most that neighbouring markers moved in all, m.
    """

    shift: float
    turn: float
    shape: float
    largest: float


class DriftMonitor:
    """Averages the displacement of frames at rest; frames in contact or in motion do not count.

    A frame counts that is still, and whose shape is the nominal surface's or the reference's.
    """

    def __init__(self, rest: RestParameters, parameters: DriftParameters) -> None:
        self._rest, self._parameters = rest, parameters
        self._reference: Reference | None = None
        self._mean: NDArray[np.float64] | None = None
        self._stamp_ns = 0
        self.drift: Drift | None = None

    def add(self, judged: FramesJudged, reference: Reference, stamp_ns: int) -> Drift | None:
        """The drift as it is now known; None before any frame at rest since the reference."""
        if reference is not self._reference:
            self._reference, self._mean, self.drift = reference, None, None
        if not judged.still or not (judged.untouched or self._like(judged, reference)):
            return self.drift
        moved = judged.position - reference.position
        if self._mean is None or stamp_ns < self._stamp_ns:
            mean = moved
        else:
            share = self._share((stamp_ns - self._stamp_ns) / NS_PER_S)
            # Where a marker was not known before, or is not now, the other value stands.
            mean = self._mean + share * (moved - self._mean)
            mean = np.where(np.isnan(mean), np.where(np.isnan(moved), self._mean, moved), mean)
        self._mean, self._stamp_ns = mean, stamp_ns
        self.drift = _drift(reference.position, mean) or self.drift
        return self.drift

    def warning(self) -> str:
        """What is wrong and what to do; empty where drift is below its limit or not known."""
        limit = self._parameters.drift_limit
        if self.drift is None or not self.drift.largest > limit:
            return ""
        return (
            f"the gel at rest has drifted by {self.drift.largest * 1e6:.0f} um since the "
            f"reference, expected at most {limit * 1e6:.0f} um: call ~/set_reference while nothing "
            "touches the gel; where it drifts again, check how gel and camera are held and "
            "calibrate"
        )

    def _like(self, judged: FramesJudged, reference: Reference) -> bool:
        shape = rest_shape(reference.position, judged.position)
        if shape is None:
            return False
        rest = self._rest
        return shape.bump <= rest.rest_tolerance and shape.shift <= rest.rest_shift

    def _share(self, elapsed_s: float) -> float:
        if self._parameters.drift_time <= 0:
            return 1.0
        return 1 - math.exp(-elapsed_s / self._parameters.drift_time)


def _drift(reference: NDArray[np.float64], moved: NDArray[np.float64]) -> Drift | None:
    motion = fit_motion(reference, reference + moved)
    if motion is None:
        return None
    return Drift(
        shift=float(np.sqrt(np.nansum(motion.shift**2))),
        turn=float(np.linalg.norm(motion.turn)),
        shape=largest_local_mean(motion.residual),
        largest=largest_local_mean(moved),
    )
