"""Keeps the reference: takes one when the gel rests, and watches the gel drift away from it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.geometry.rigid_motion import fit_motion, largest_local_mean
from cmp_tactile_processing.measured import NS_PER_S, Markers3D, ReferenceFault, Surface
from cmp_tactile_processing.sensor.parameters import Parameters, parameter
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.surface.gauge import RestGauge
from cmp_tactile_processing.surface.stillness import (
    FramesJudged,
    RestParameters,
    StillnessWatch,
    rest_shape,
    why_touched,
)

# Sets of frames after which the gauge looks again at a gel that seems touched, at most.
MAX_PASSED_OVER = 31
# Between what was done and why it is doubtful.
DOUBTFUL = "; but "


@dataclass(frozen=True)
class DriftParameters(Parameters, section="drift"):
    """What drift of the gel at rest is followed and reported."""

    drift_time: float = parameter(
        10.0, "time constant of the average of the drift at rest", unit="s", within=(0.0, 3600.0)
    )
    drift_limit: float = parameter(
        15e-6,
        "drift of the gel at rest since the reference, of the whole gel or of neighbouring "
        "markers, above which a warning is given",
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

    A frame counts that is still, and has a shape that is the nominal surface's or the reference's.
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
            f"reference, expected at most {limit * 1e6:.0f} um: zero again while nothing touches "
            "the gel; if it drifts again, check the mounting of gel and camera, and calibrate"
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


@dataclass(frozen=True)
class ZeroParameters(Parameters, section="reference"):
    """When a reference is taken without being asked for."""

    auto_reference: str = parameter(
        "when_still",
        "when the node takes a reference: as soon as the gel is still and untouched "
        "(when_still), only if it is so in the first frames (at_start), or never",
        choices=("when_still", "at_start", "never"),
    )
    auto_rezero: bool = parameter(
        False,
        "take a new reference automatically if the gel, still and untouched, has drifted beyond "
        "drift_limit",
    )


class ReferenceKeeper:
    """Holds the `reference`, at first the nominal surface.

    `waiting`: a reference is still to be taken by itself.  `reason`: why none has been so far.
    gauge: of a sensor with views; what it shows of the description goes into each reference.
    """

    def __init__(self, nominal: Reference, gauge: RestGauge | None = None) -> None:
        self._nominal, self._gauge = nominal, gauge
        self.reference = nominal
        self.waiting = True
        self.reason = ""
        self._doubt = ""
        self.judged: FramesJudged | None = None
        # Sets of frames of a gel that seems touched, since the gauge last looked at one.
        self._passed_over = self._between_tries = 0
        self._zero = ZeroParameters()
        self.watch(RestParameters(), DriftParameters())

    def zero(self, parameters: ZeroParameters) -> None:
        """When to take a reference by itself; where that is new, waits for it, unless never."""
        if parameters.auto_reference != self._zero.auto_reference:
            self.waiting, self.reason = parameters.auto_reference != "never", ""
        self._zero = parameters

    def watch(self, rest: RestParameters, drift: DriftParameters) -> None:
        """What rest and drift are; both are judged again from now on."""
        self._rest, self._drift_parameters = rest, drift
        self._stillness = StillnessWatch(self._nominal.position, rest)
        self._drift = DriftMonitor(rest, drift)

    @property
    def drift(self) -> Drift | None:
        """Drift of the gel at rest since the reference; None while it was not seen at rest."""
        return self._drift.drift

    def take(self, frames: Sequence[Markers3D], stamp_ns: int) -> str:
        """Measure against the mean of these frames from now on; what is to be said of it.

        Raises CalibrationError where they cannot serve; all then stays as it was.
        """
        reference = Reference.average(frames, self.reference.id + 1, stamp_ns)
        return self._use(*self._gauged(reference), len(frames))

    def surface(self, markers: Markers3D) -> Surface:
        """The markers with their displacement from the reference.

        A surface that was measured elsewhere keeps its own until one is taken.
        """
        if isinstance(markers, Surface) and not self.reference.id:
            return markers
        return self.reference.surface(markers)

    def _gauged(self, reference: Reference) -> tuple[Reference, str]:
        """The reference with what it shows of the gel and the description, and that in words."""
        shape, reading = rest_shape(self._nominal.position, reference.position), None
        if self._gauge is not None and reference.pixels is not None:
            reading = self._gauge.read(reference.pixels)
        if reading is None or shape is None:
            return reference, why_touched(shape, self._rest)
        faults, doubt = ReferenceFault.NONE, reading.doubt
        if reading.bump > self._rest.rest_tolerance:
            # A dent looks like errors of the description, in part.
            faults, doubt = ReferenceFault.TOUCHED, why_touched(shape, self._rest) or doubt
        elif doubt:
            faults = ReferenceFault.DESCRIPTION
        reference = replace(reference, faults=faults, systematics=reading.systematics)
        # What the description explains is no touch; a drag may be explained by the gel's pose.
        shape = replace(shape, bump=min(shape.bump, reading.bump), scale=1.0)
        return reference, doubt or why_touched(shape, self._rest)

    def _use(self, reference: Reference, doubt: str, frames: int) -> str:
        left_out = f" of {frames}" if reference.frames < frames else ""
        said = f"reference {reference.id} is the mean of {reference.frames}{left_out} frames"
        self.reference, self.waiting, self.reason = reference, False, ""
        self._passed_over = self._between_tries = 0
        self._doubt = doubt
        self._drift = DriftMonitor(self._rest, self._drift_parameters)
        return f"{said}{DOUBTFUL}{doubt}" if doubt else said

    def add(self, markers: Markers3D, stamp_ns: int) -> str:
        """Take a frame into account; what is to be said where it led to a new reference."""
        judged = self._stillness.add(markers, stamp_ns)
        if judged is None:
            return ""
        self.judged = judged
        if self.waiting:
            return self._awaited(judged, stamp_ns)
        self._drift.add(judged, self.reference, stamp_ns)
        if self._zero.auto_rezero and self._drift.warning() and judged.at_rest:
            # What drifted is reported until frames can serve.
            with contextlib.suppress(CalibrationError):
                return self._taken(judged, stamp_ns)
        return ""

    def warning(self) -> str:
        """What is wrong with the reference and what to do; empty where nothing is."""
        if self._zero.auto_reference != "never" and self.reason:
            later = "it is taken when this has ended" if self.waiting else "none was taken at start"
            number = self.reference.id
            kept = f"new reference yet, displacement is relative to reference {number}"
            if not number:
                kept = "reference yet, displacement is relative to the nominal surface"
            return f"no {kept}: {self.reason}; {later}, or when you zero"
        if self._doubt:
            return (
                f"reference {self.reference.id} is doubtful: {self._doubt}; zero again "
                "while nothing touches the gel, or calibrate"
            )
        return self._drift.warning()

    def _taken(self, judged: FramesJudged, stamp_ns: int) -> str:
        average = Reference.average(judged.frames, self.reference.id + 1, stamp_ns)
        reference, doubt = self._gauged(average)
        # A gel that is described wrongly rests as well: its reference is used, and flagged.
        if doubt and reference.faults != ReferenceFault.DESCRIPTION:
            raise CalibrationError(doubt)
        return self._use(reference, doubt, len(judged.frames)) + ", taken automatically"

    def _awaited(self, judged: FramesJudged, stamp_ns: int) -> str:
        self.reason = judged.reason
        if judged.still and (judged.untouched or self._passed_over >= self._between_tries):
            try:
                return self._taken(judged, stamp_ns)
            except CalibrationError as error:
                self.reason = str(error)
                # The gauge takes as long as some frames: what lasts is looked at more rarely.
                self._passed_over = 0
                self._between_tries = min(2 * self._between_tries + 1, MAX_PASSED_OVER)
        self._passed_over += 1
        if judged.seen and self._zero.auto_reference == "at_start":
            self.waiting = False
        return ""
