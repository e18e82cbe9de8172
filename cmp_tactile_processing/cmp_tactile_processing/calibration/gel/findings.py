"""What speaks against a calibration by the gel's own pattern, in words, and what to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cmp_tactile_processing.calibration.gel.fit import GelFit, GelShape
from cmp_tactile_processing.calibration.gel.parameters import GelCalibrationParameters
from cmp_tactile_processing.calibration.observation import ViewObservation, usual_complaint
from cmp_tactile_processing.calibration.outcome import Finding, Severity
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = [
    "count_findings",
    "deviation_findings",
    "frame_list",
    "motion_findings",
    "reprojection_findings",
    "shape_findings",
    "sight_findings",
]

# Parts of the pattern move from frame to frame by this many standard deviations of a corner at
# most: noise alone, averaged over 3 x 3 corners.
NOISE_MOTION = 3.0
# Of the surface's deviations, this many standard deviations may be noise and flaws of the print.
NOISE_SHAPE = 4.0
MOST_LISTED = 6


def frame_list(numbers: Sequence[int]) -> str:
    """Frames of these indices, from 0, by their numbers from 1: "frames 2, 5, 6"."""
    listed = ", ".join(str(number + 1) for number in numbers[:MOST_LISTED])
    more = f" and {len(numbers) - MOST_LISTED} more" if len(numbers) > MOST_LISTED else ""
    return f"frame{'s' if len(numbers) > 1 else ''} {listed}{more}"


def count_findings(count: int, options: GelCalibrationParameters) -> list[Finding]:
    """Too few frames that show the pattern?"""
    if count >= options.wanted_frames:
        return []
    few = count < options.fewest_frames
    text = f"Only {count} frame{'s' if count != 1 else ''} could be used"
    if few:
        text += ": too few to know whether the gel was still."
    else:
        text += ": noise is averaged less than it could be."
    return [
        Finding(
            Severity.ERROR if few else Severity.WARNING,
            text,
            f"Record {options.wanted_frames} frames or more while nothing touches the gel.",
        )
    ]


def sight_findings(
    grids: Mapping[str, Sequence[Grid]],
    seen: Sequence[ViewObservation],
    options: GelCalibrationParameters,
) -> list[Finding]:
    """Is the pattern hidden in some frames, or a part of it in all?"""
    findings = []
    for name, view in grids.items():
        bad = [k for k, grid in enumerate(view) if grid.found_fraction < options.least_seen]
        if bad:
            text = (
                f"The {name} view shows less than {options.least_seen:.0%} of the pattern in "
                f"{frame_list(bad)}: {usual_complaint([view[k] for k in bad])}. Left out."
            )
            findings.append(Finding(Severity.WARNING, text, _LOOK))
    for item in seen:
        share = float(item.seen.mean())
        if share >= options.wanted_seen:
            continue
        text = (
            f"The {item.view} view shows {share:.0%} of the pattern: {usual_complaint(item.grids)}."
        )
        findings.append(Finding.graded(text, _LOOK, error=share < options.least_seen))
    return findings


_LOOK = (
    "Look at the recording: is the whole pattern lit, in focus, clean, and within its part of the "
    "frame?"
)


def motion_findings(
    seen: Sequence[ViewObservation], options: GelCalibrationParameters
) -> list[Finding]:
    """Do the frames differ?"""
    findings = []
    for item in seen:
        limit = max(options.still_limit, NOISE_MOTION * item.noise)
        motion = item.motion
        moved = [int(number) for number in item.numbers[motion > limit]]
        if moved:
            text = (
                f"Something moved during the recording: {frame_list(moved)} differ from "
                f"the others by up to {motion.max():.2g} px in the {item.view} view "
                f"(limit {limit:.2g} px)."
            )
            advice = (
                "Record again without touching the gel, and let it recover from the last contact."
            )
            findings.append(Finding(Severity.ERROR, text, advice))
    return findings


def shape_findings(
    sensor: SensorDescription, shape: GelShape, options: GelCalibrationParameters
) -> list[Finding]:
    """Is the surface, measured with the result, the one at rest?"""
    beyond = shape.peak - NOISE_SHAPE * shape.noise
    if beyond <= options.shape_wanted:
        return []
    error = beyond > options.shape_limit
    row, col = shape.peak_corner
    x, y = sensor.pattern.corners()[row, col, :2] * 1e3
    off = shape.deviation[row, col] * 1e3
    how = "by " + ", ".join(
        f"{value:+.3f} mm along {axis}"
        for axis, value in zip("xyz", off, strict=True)
        if np.isfinite(value)
    )
    if shape.local:
        text = (
            f"The marker surface differs from its shape at rest around x = {x:.1f} mm, "
            f"y = {y:.1f} mm (corner {row}, {col}) {how}: the gel was touched."
        )
        advice = "Record the gel at rest: nothing may touch it, and it needs time to recover."
        return [Finding.graded(text, advice, error=error)]
    text = (
        f"The marker surface as a whole differs from its shape at rest, most at x = {x:.1f} mm, "
        f"y = {y:.1f} mm {how}: the pattern or its surface is not as described."
    )
    surface = sensor.pattern.surface
    known = f", pattern.surface ({surface.type}"
    known += f" of radius {surface.radius * 1e3:.4g} mm)" if np.isfinite(surface.radius) else ")"
    advice = (
        f"Does something flat touch the gel? Else measure pattern.pitch "
        f"({sensor.pattern.pitch * 1e3:.4g} mm){known}, the camera's distortion and optics.layers, "
        "and correct the description."
    )
    return [Finding.graded(text, advice, error=error)]


def deviation_findings(
    sensor: SensorDescription, found: GelFit, options: GelCalibrationParameters
) -> list[Finding]:
    """Did the fit go further than a sensor of this kind may differ from its description?"""
    findings = []
    far = found.fit.deviations > options.largest_deviation
    if far.any():
        names = [name for name, is_far in zip(found.parameters.names, far, strict=True) if is_far]
        text = (
            f"The fit is at the limits of what it may change: {', '.join(names)} "
            f"{'differ' if len(names) > 1 else 'differs'} by more than "
            f"{options.largest_deviation:g} standard deviations from the description."
        )
        advice = "Is this the description of this kind of sensor? Else correct its rough values."
        findings.append(Finding(Severity.ERROR, text, advice))
    growth = _growth(sensor, found.sensor)
    if abs(growth) > options.scale_limit:
        text = (
            f"All distances {'grew' if growth > 0 else 'shrank'} by {abs(growth):.0%}: so does a "
            "rig with a pattern that is larger or smaller than described."
        )
        pitch = sensor.pattern.pitch * 1e3
        advice = f"Measure pattern.pitch ({pitch:.4g} mm): the images show it and distance alike."
        findings.append(Finding(Severity.WARNING, text, advice))
    return findings


def reprojection_findings(rms: float, options: GelCalibrationParameters) -> list[Finding]:
    """Does the fitted model describe the images?  rms: px, of the corners that are no outliers."""
    if rms <= options.reprojection_limit:
        return []
    text = (
        f"The pattern's corners do not fit: they are {rms:.2g} px off (limit "
        f"{options.reprojection_limit:g} px)."
    )
    advice = (
        "Was the gel at rest?  Else check pattern, distortion of the camera and optics.layers in "
        "the description, which are not refined."
    )
    return [Finding(Severity.ERROR, text, advice)]


def _growth(before: SensorDescription, after: SensorDescription) -> float:
    """Relative change of the mean distance from the views' centres to the apex of the gel."""
    distances = [
        np.mean([np.linalg.norm(view.centre) for view in build_views(sensor).values()])
        for sensor in (before, after)
    ]
    return float(distances[1] / distances[0] - 1)
