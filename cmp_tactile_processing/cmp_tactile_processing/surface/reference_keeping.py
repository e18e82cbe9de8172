"""Keeps the reference: takes one when the gel rests, and watches the gel drift away from it."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

from cmp_tactile_processing.errors import ReferenceFramesError
from cmp_tactile_processing.measured.markers_3d import Markers3D
from cmp_tactile_processing.sensor.parameters import Parameters, parameter
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.surface.drift import Drift, DriftMonitor, DriftParameters
from cmp_tactile_processing.surface.stillness import (
    FramesJudged,
    RestParameters,
    StillnessWatch,
    rest_shape,
    why_touched,
)

__all__ = ["ReferenceKeeper", "ZeroParameters"]


@dataclass(frozen=True)
class ZeroParameters(Parameters, section="reference"):
    """When a reference is taken without being asked for."""

    auto_reference: str = parameter(
        "when_still",
        "when a reference is taken by itself: as soon as the gel is still and untouched, only if "
        "it is so in the first frames, or never",
        choices=("when_still", "at_start", "never"),
    )
    auto_rezero: bool = parameter(
        False,
        "take a new reference by itself where the gel, still and untouched, has drifted beyond "
        "drift_limit",
    )


class ReferenceKeeper:
    """Holds the `reference`, at first the nominal surface.

    `waiting`: a reference is still to be taken by itself.  `reason`: why none has been so far.
    """

    def __init__(self, nominal: Reference) -> None:
        self._nominal = nominal
        self.reference = nominal
        self.waiting = True
        self.reason = ""
        self.judged: FramesJudged | None = None
        self._zero = ZeroParameters()
        self.watch(RestParameters(), DriftParameters())

    def zero(self, parameters: ZeroParameters) -> None:
        """When to take a reference by itself; where that is new, waits for it, unless never."""
        if parameters.auto_reference != self._zero.auto_reference:
            self.waiting, self.reason = parameters.auto_reference != "never", ""
        self._zero = parameters

    def watch(self, rest: RestParameters, drift: DriftParameters) -> None:
        """What rest and drift are; both are judged anew from now on."""
        self._rest, self._drift_parameters = rest, drift
        self._stillness = StillnessWatch(self._nominal.position, rest)
        self._drift = DriftMonitor(rest, drift)

    @property
    def drift(self) -> Drift | None:
        """Drift of the gel at rest since the reference; None while it was not seen at rest."""
        return self._drift.drift

    def take(self, frames: Sequence[Markers3D], stamp_ns: int) -> str:
        """Measure against the mean of these frames from now on; what is to be said of it.

        Raises ReferenceFramesError where they cannot serve; all then stays as it was.
        """
        number = self.reference.id + 1
        reference = Reference.average(frames, number, stamp_ns)
        left_out = f" of {len(frames)}" if reference.frames < len(frames) else ""
        said = f"reference {number} is the mean of {reference.frames}{left_out} frames"
        shape = rest_shape(self._nominal.position, reference.position)
        doubt = why_touched(shape, self._rest)
        self.reference, self.waiting, self.reason = reference, False, ""
        self._drift = DriftMonitor(self._rest, self._drift_parameters)
        return f"{said}; but {doubt}" if doubt else said

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
            # What drifted is told until frames can serve.
            with contextlib.suppress(ReferenceFramesError):
                return self._taken(judged, stamp_ns)
        return ""

    def warning(self) -> str:
        """What is wrong with the reference and what to do; empty where nothing is."""
        if self._zero.auto_reference != "never" and self.reason:
            later = "it is taken once that is over" if self.waiting else "none was taken at start"
            number = self.reference.id
            kept = f"new reference yet, displacement is against reference {number}"
            if not number:
                kept = "reference yet, displacement is against the nominal surface"
            return f"no {kept}: {self.reason}; {later}, or by ~/set_reference"
        return self._drift.warning()

    def _taken(self, judged: FramesJudged, stamp_ns: int) -> str:
        return self.take(judged.frames, stamp_ns) + ", taken by itself"

    def _awaited(self, judged: FramesJudged, stamp_ns: int) -> str:
        self.reason = judged.reason
        if judged.at_rest:
            try:
                return self._taken(judged, stamp_ns)
            except ReferenceFramesError as error:
                self.reason = str(error)
        if judged.seen and self._zero.auto_reference == "at_start":
            self.waiting = False
        return ""
