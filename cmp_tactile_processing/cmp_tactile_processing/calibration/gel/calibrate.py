"""Calibration from frames of the gel at rest: its own pattern is the target.

Pitch and surface of the pattern are known; where its corners are seen shows the pose of the gel,
the mirrors and the focal length.  What the corners do not show keeps what the description says: two
mirrored views do not show the real camera, so turning both mirrors about the line in which their
planes meet, together with the gel, changes nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration import observation
from cmp_tactile_processing.calibration.gel.fit import (
    GelCalibrationParameters,
    GelFit,
    GelShape,
    count_findings,
    deviation_findings,
    fit_gel,
    fitted_uncertainty,
    gel_shape,
    motion_findings,
    reprojection_findings,
    shape_findings,
    sight_findings,
    view_residuals,
)
from cmp_tactile_processing.calibration.map_fit import MapFit
from cmp_tactile_processing.calibration.outcome import (
    CalibrationOutcome,
    Estimate,
    finding,
    length_text,
    number_text,
    provenance,
    reprojection,
    rig_estimates,
)
from cmp_tactile_processing.errors import CalibrationError, Finding, errors_in
from cmp_tactile_processing.geometry.rectification import Rectification
from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.processes import OnProgress, no_progress
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import CalibrationRecord

# Exchanged views fit this much better the other way round.
SWAP_GAIN = 5.0
# A combination of parameters is named by those that have this share of it.
NAMED_SHARE = 0.2

_EXCHANGE = "swap the cameras' cables, or views.left.roi and views.right.roi"


def calibrate_gel(
    sensor: SensorDescription,
    frames: Sequence[NDArray[np.uint8]],
    options: GelCalibrationParameters | None = None,
    on_progress: OnProgress = no_progress,
) -> CalibrationOutcome:
    """Refine the optical values of a description from frames of the gel at rest.

    frames: (H, W) grey or (H, W, 3) BGR uint8, of the size that the description says.
    What is wrong with frames or result is among the outcome's findings.  Raises CalibrationError
    where nothing can be fitted: no frames, or no pattern in any of them; InputError for a
    view that does not show the pattern; FrameError that names a frame of another size.
    """
    options = options or GelCalibrationParameters()
    grids = observation.track_frames(sensor, frames, on_progress)
    if not _usable(grids, options).any():
        _refuse_exchanged(sensor, frames[0], options)
    on_progress("fitting", 0.0)
    outcome = calibrate_gel_grids(sensor, grids, options)
    on_progress("fitting", 1.0)
    return outcome


def calibrate_gel_grids(
    sensor: SensorDescription,
    grids: Mapping[str, Sequence[Grid]],
    options: GelCalibrationParameters | None = None,
) -> CalibrationOutcome:
    """`calibrate_gel` from what a tracker found: grids of the same frames, by view.

    Raises CalibrationError where no frame shows the pattern in all views, and for grids of other
    views than the sensor's, of another shape, or not as many of each.
    """
    options = options or GelCalibrationParameters()
    observation.require_grids(sensor, grids)
    usable = _usable(grids, options)
    if not usable.any():
        raise CalibrationError(_unseen(grids, options))
    seen = [observation.observed(name, view, usable) for name, view in grids.items()]
    found = fit_gel(sensor, seen, options)
    evidence = _Evidence(sensor, seen, found, gel_shape(found.sensor, seen), options)
    findings = (
        *count_findings(int(usable.sum()), options),
        *sight_findings(grids, seen, options),
        *motion_findings(seen, options),
        *_fit_findings(evidence, options),
    )
    return _outcome(evidence, findings)


@dataclass(frozen=True)
class _Evidence:
    before: SensorDescription
    seen: Sequence[observation.ViewObservation]
    found: GelFit
    shape: GelShape
    options: GelCalibrationParameters


def _usable(
    grids: Mapping[str, Sequence[Grid]], options: GelCalibrationParameters
) -> NDArray[np.bool_]:
    """Which frames (F,) show enough of the pattern in all views."""
    shows = [_shows(view, options) for view in grids.values()]
    return np.asarray(np.logical_and.reduce(shows))


def _unseen(grids: Mapping[str, Sequence[Grid]], options: GelCalibrationParameters) -> str:
    """What is said where no frame is usable."""
    shows = {name: _shows(view, options) for name, view in grids.items()}
    name = min(shows, key=lambda view: int(shows[view].sum()))
    return (
        f"{name} view: found the pattern in {shows[name].sum()} of {shows[name].size} frames "
        f"({observation.usual_complaint(grids[name])}), expected frames that show at least "
        f"{options.least_seen:.0%} of it in all views; check light and focus, and whether this is "
        "the description of the sensor"
    )


def _refuse_exchanged(
    sensor: SensorDescription, frame: NDArray[np.uint8], options: GelCalibrationParameters
) -> None:
    """Raise CalibrationError where the pattern is seen with left for right."""
    exchanged = _exchanged_halves(sensor, frame)
    if exchanged is None:
        return
    if _usable(observation.track_frames(sensor, [exchanged]), options).all():
        msg = (
            f"{sensor.name}: found the left view's image in the right view's part of the frames "
            f"and vice versa: {_EXCHANGE}"
        )
        raise CalibrationError(msg)


def _shows(grids: Sequence[Grid], options: GelCalibrationParameters) -> NDArray[np.bool_]:
    return np.array([grid.found_fraction >= options.least_seen for grid in grids])


def _exchanged_halves(
    sensor: SensorDescription, frame: NDArray[np.uint8]
) -> NDArray[np.uint8] | None:
    """The frame with its views' parts exchanged; None where there are not two of one size."""
    rois = [view.roi for view in sensor.views.values()]
    if len(rois) < 2 or (rois[0].width, rois[0].height) != (rois[1].width, rois[1].height):
        return None
    cuts = [np.s_[roi.y : roi.y + roi.height, roi.x : roi.x + roi.width] for roi in rois]
    exchanged: NDArray[np.uint8] = np.array(frame, dtype=np.uint8)
    exchanged[cuts[0]], exchanged[cuts[1]] = frame[cuts[1]], frame[cuts[0]]
    return exchanged


def _fit_findings(evidence: _Evidence, options: GelCalibrationParameters) -> list[Finding]:
    """Does the model describe the images, with values and a surface that can be?"""
    sensor, seen, found = evidence.before, evidence.seen, evidence.found
    residuals = view_residuals(found.sensor, seen, found.print_px)
    findings = deviation_findings(sensor, found, options)
    rms = reprojection(residuals)
    if rms > options.reprojection_limit or findings:
        swapped = _swap_findings(evidence, options)
        if swapped:
            return swapped
    findings = shape_findings(found.sensor, evidence.shape, options) + findings
    if not errors_in(findings):
        findings += reprojection_findings(rms, options)
    return findings


def _swap_findings(evidence: _Evidence, options: GelCalibrationParameters) -> list[Finding]:
    """Do the images fit better with left and right exchanged?"""
    if len(evidence.seen) < 2:
        return []
    rms = _rms(evidence.found, evidence.seen)
    one, other = evidence.seen
    exchanged = [replace(other, view=one.view), replace(one, view=other.view)]
    swapped = fit_gel(evidence.before, exchanged, options)
    better = _rms(swapped, exchanged)
    if better * SWAP_GAIN > rms or better > options.reprojection_limit:
        return []
    texts = {"better": number_text(better, 2), "rms": number_text(rms, 2)}
    return [finding("views swapped", error=True, exchange=_EXCHANGE.capitalize(), **texts)]


def _rms(found: GelFit, seen: Sequence[observation.ViewObservation]) -> float:
    return reprojection(view_residuals(found.sensor, seen, found.print_px), all_corners=True)


def _outcome(evidence: _Evidence, findings: tuple[Finding, ...]) -> CalibrationOutcome:
    found, seen = evidence.found, evidence.seen
    residuals = view_residuals(found.sensor, seen, found.print_px)
    estimates = _estimates(found)
    record = CalibrationRecord(
        method="gel",
        frames=len(seen[0].frames),
        reprojection=reprojection(residuals),
        ray_gap=evidence.shape.rms_gap,
        **provenance(estimates),
    )
    uncertainty = fitted_uncertainty(evidence.before, seen, found, evidence.options)
    sensor = replace(found.sensor, calibration=record, uncertainty=uncertainty)
    info = Rectification(sensor)
    outcome = CalibrationOutcome(
        method="gel",
        sensor=sensor,
        cameras={name: info.info(name) for name in sensor.views},
        estimates=estimates,
        residuals=residuals,
        findings=findings,
    )
    return replace(outcome, verdict=_verdict(outcome, evidence))


def _estimates(found: GelFit) -> tuple[Estimate, ...]:
    """All optical values, then the combinations of them that the images leave open."""
    fit, names = found.fit, found.parameters.names
    estimates = list(rig_estimates(found.parameters, fit))
    for combination in fit.combinations:
        if not combination.held:
            continue
        share = np.abs(combination.direction)
        parts = [names[k] for k in np.argsort(-share) if share[k] >= NAMED_SHARE]
        along = float(combination.direction @ (fit.values / fit.prior_std))
        name = "together: " + ", ".join(parts)
        estimates.append(
            Estimate(name, "prior deviations", 0.0, along, combination.share, determined=False)
        )
    return tuple(estimates)


def _verdict(outcome: CalibrationOutcome, evidence: _Evidence) -> str:
    found, seen = evidence.found, evidence.seen
    before = reprojection(view_residuals(evidence.before, seen, found.print_px), all_corners=True)
    after = reprojection(outcome.residuals, all_corners=True)
    after_px, before_px = number_text(after, 2), number_text(before, 2)
    fit = f"The RMS error of the corners is {after_px} px; it was {before_px} px before"
    gap = evidence.shape.rms_gap
    if np.isfinite(gap):
        fit += f", and the rays of both views meet within {length_text(gap, 2)}"
    if not outcome.accepted:
        errors = errors_in(outcome.findings)
        return f"Not usable. {errors[0].text} {fit}."
    return f"Usable. {fit}. {_known(found.fit)}"


def _known(fit: MapFit) -> str:
    """How much the images determine, in words."""
    count, values = int(fit.determined.sum()), len(fit.values)
    others, unseen = values - count, sum(item.held for item in fit.combinations)
    known = f"The images determine {count} of {values} values"
    if not others:
        return f"{known}."
    if unseen >= others:
        return f"{known}; the other {others} keep the values of the description."
    together = f"{known}; the other {others} have similar effects and are found together"
    if not unseen:
        return f"{together}."
    left = "one combination" if unseen == 1 else f"{unseen} combinations"
    return f"{together}, except {left}, which the images do not determine."
