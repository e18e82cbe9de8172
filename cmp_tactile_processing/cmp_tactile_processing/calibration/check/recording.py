"""Does a recording keep to what the sensor's calibration promises?

Works on any recording, at rest or in contact: the two views must agree in every frame; frames of
the gel at rest must also show it where the description has it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.check.evidence import (
    CheckedRecording,
    CheckParameters,
    RigidDrift,
)
from cmp_tactile_processing.calibration.observation import (
    require_grids,
    track_frames,
    usual_complaint,
)
from cmp_tactile_processing.calibration.outcome import (
    Finding,
    Progress,
    Severity,
    ViewResiduals,
    WithFindings,
    errors_in,
    silent,
)
from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.measured.grid import Grid
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["CheckFigure", "CheckParameters", "CheckReport", "check_grids", "check_recording"]

JUDGED_PERCENT = 95.0


@dataclass(frozen=True)
class CheckFigure:
    """One figure and its limit, in `unit`.

    value: what is held against the limit; at_least: whether it must reach it, instead of staying
    below.  median, p95, maximum: over markers and frames; NaN for a single number.
    advice: what to do where it is out of its limit.
    """

    name: str
    unit: str
    value: float
    limit: float
    advice: str
    at_least: bool = False
    median: float = float("nan")
    p95: float = float("nan")
    maximum: float = float("nan")

    @property
    def kept(self) -> bool:
        """Whether the limit is kept."""
        return self.value >= self.limit if self.at_least else self.value <= self.limit


@dataclass(frozen=True)
class CheckReport(WithFindings):
    """What the check of a recording found.

    frames: how many there are; rest_frames: indices of those of the gel at rest, from which drift
    is measured.  residuals: of the reprojection, all frames, by view; of the known surface at rest
    for one view.  drift: motion of the gel at rest against the description, None without such
    frames.
    """

    sensor: SensorDescription
    frames: int
    rest_frames: tuple[int, ...]
    figures: tuple[CheckFigure, ...]
    residuals: tuple[ViewResiduals, ...]
    drift: RigidDrift | None
    findings: tuple[Finding, ...]
    verdict: str


def check_recording(
    sensor: SensorDescription,
    frames: Sequence[NDArray[np.uint8]],
    on_progress: Progress = silent,
    limits: CheckParameters | None = None,
) -> CheckReport:
    """Check the calibration of a sensor on frames, (H, W) grey or (H, W, 3) BGR uint8.

    Raises CalibrationError without frames or where none shows the pattern, FrameError that names a
    frame of another size.
    """
    return check_grids(sensor, track_frames(sensor, frames, on_progress), limits)


def check_grids(
    sensor: SensorDescription,
    grids: Mapping[str, Sequence[Grid]],
    limits: CheckParameters | None = None,
) -> CheckReport:
    """`check_recording` of what a tracker found: grids of the same frames, by view.

    Raises CalibrationError where none shows the pattern, and for grids of other views than the
    sensor's, of another shape, or not as many of each.
    """
    limits = limits or CheckParameters()
    require_grids(sensor, grids)
    seen = CheckedRecording(sensor, grids, limits)
    if not np.isfinite(seen.positions[..., 0]).any():
        complaints = "; ".join(f"{name}: {usual_complaint(view)}" for name, view in grids.items())
        msg = (
            f"{sensor.name}: found no marker in any of {len(seen.positions)} frames ({complaints})"
        )
        raise CalibrationError(msg)
    rest = seen.rest()
    drift = seen.drift(rest)
    residuals = seen.residuals(rest)
    figures = (
        *_agreement_figures(seen, residuals, limits),
        *_rest_figures(seen, rest, drift, limits),
    )
    findings = _findings(sensor, figures, rest)
    return CheckReport(
        sensor=sensor,
        frames=len(seen.positions),
        rest_frames=tuple(int(number) for number in rest),
        figures=figures,
        residuals=residuals,
        drift=drift,
        findings=findings,
        verdict=_verdict(figures, findings),
    )


def _agreement_figures(
    seen: CheckedRecording, residuals: Sequence[ViewResiduals], limits: CheckParameters
) -> list[CheckFigure]:
    """Do the views agree?"""
    tracked = CheckFigure(
        name="markers measured",
        unit="",
        value=seen.tracked,
        limit=limits.tracked,
        advice="Look at light, focus and dirt, and at what hides the pattern.",
        at_least=True,
    )
    if not seen.two_views:
        return [tracked]
    lengths = [np.linalg.norm(item.residuals, axis=-1) for item in residuals]
    recalibrate = (
        "A mirror or the camera has moved, or this is another sensor's description: calibrate "
        "again from frames of the gel at rest."
    )
    return [
        _spread("reprojection", "px", np.concatenate(lengths), limits.reprojection, recalibrate),
        _spread("epipolar error", "px", seen.epipolar(), limits.epipolar, recalibrate),
        _spread("ray gap", "m", seen.gaps[np.isfinite(seen.gaps)], limits.ray_gap, recalibrate),
        tracked,
    ]


def _spread(
    name: str, unit: str, values: NDArray[np.float64], limit: float, advice: str
) -> CheckFigure:
    median, p95, most = (float(v) for v in np.percentile(values, [50, JUDGED_PERCENT, 100]))
    return CheckFigure(name, unit, p95, limit, advice, median=median, p95=p95, maximum=most)


def _rest_figures(
    seen: CheckedRecording,
    rest: NDArray[np.intp],
    drift: RigidDrift | None,
    limits: CheckParameters,
) -> list[CheckFigure]:
    """Is the gel at rest where the description has it?"""
    if drift is None:
        return []
    moved = (
        "The gel or a mirror has moved since calibration, as after remounting: calibrate again "
        "from frames of the gel at rest."
    )
    bent = (
        "Is the gel really at rest? Else it is worn or another one: check pattern and surface in "
        "the description, and calibrate again."
    )
    record = seen.sensor.calibration
    promised = record.reprojection if record is not None else 0.0
    return [
        CheckFigure(
            "corners at rest",
            "px",
            seen.rest_reprojection(rest),
            max(limits.rest_reprojection, 3 * promised),
            moved,
        ),
        CheckFigure("turn", "rad", float(np.linalg.norm(drift.turn)), limits.turn, moved),
        CheckFigure("shift", "m", float(np.linalg.norm(drift.shift)), limits.shift, moved),
        CheckFigure("growth", "", abs(drift.growth), limits.scale, moved),
        CheckFigure("shape at rest", "m", drift.shape_peak, limits.shape, bent),
    ]


def _findings(
    sensor: SensorDescription, figures: Sequence[CheckFigure], rest: NDArray[np.intp]
) -> tuple[Finding, ...]:
    findings = []
    for figure in figures:
        if figure.kept:
            continue
        wanted = "at least" if figure.at_least else "at most"
        whom = f" for {JUDGED_PERCENT:g} % of the markers" if np.isfinite(figure.p95) else ""
        text = (
            f"{figure.name[0].upper()}{figure.name[1:]}: found {_shown(figure.value, figure.unit)}"
            f"{whom}, expected {wanted} {_shown(figure.limit, figure.unit)}."
        )
        findings.append(Finding(Severity.ERROR, text, figure.advice))
    if not len(rest):
        text = "No two frames in a row show the gel at rest: whether it has drifted is not known."
        advice = (
            "Record some frames while nothing touches the gel; if these are, its pattern is seen "
            "so far from where it should be that the sensor must be calibrated again."
        )
        findings.append(Finding.graded(text, advice, error=len(sensor.views) != 2))
    return tuple(findings)


def _verdict(figures: Sequence[CheckFigure], findings: Sequence[Finding]) -> str:
    errors = errors_in(findings)
    if errors:
        return f"Do not measure with this calibration. {errors[0].text} {errors[0].advice}"
    listed = ", ".join(
        f"{figure.name} {_shown(figure.value, figure.unit)} (limit "
        f"{_shown(figure.limit, figure.unit)})"
        for figure in figures
    )
    unknown = " Drift is not known: no frame shows the gel at rest." if findings else ""
    return f"The calibration holds: {listed}.{unknown}"


def _shown(value: float, unit: str) -> str:
    """A value as people read it."""
    if unit == "m":
        return f"{value * 1e6:.3g} um"
    if unit == "rad":
        return f"{np.degrees(value):.2g} degrees"
    return f"{value:.3g} {unit}".rstrip() if unit else f"{value:.2%}"
