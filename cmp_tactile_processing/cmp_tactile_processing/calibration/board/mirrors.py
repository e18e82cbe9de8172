"""Calibration of a camera and its two mirrors from frames of a board, before the gel is mounted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.board import findings as findings_of
from cmp_tactile_processing.calibration.board.bundle import Prior
from cmp_tactile_processing.calibration.board.images import (
    corners_of,
    findings_of_images,
    look_for_board,
)
from cmp_tactile_processing.calibration.board.models import MirrorRig
from cmp_tactile_processing.calibration.board.result import (
    estimates_of,
    outcome_of,
    record_of,
    refused,
    residuals_of,
)
from cmp_tactile_processing.calibration.board.start import Corners, RigFit, fit_rig, start_error
from cmp_tactile_processing.calibration.board.target import BoardTarget
from cmp_tactile_processing.calibration.outcome import CalibrationOutcome, Severity
from cmp_tactile_processing.calibration.progress import Progress, silent
from cmp_tactile_processing.errors import CalibrationError, CmpTactileError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.rectification import Rectification
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured.grid import ViewPlacement
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Camera, Mirror

__all__ = ["calibrate_mirror_rig"]

# How far a mirror rig may be from its description: standard deviations, relative, px of the frame's
# width, radial and tangential distortion, rad, relative.
FOCAL, CENTRE, RADIAL, TANGENTIAL = 0.1, 0.1, 0.5, 0.05
TILT, DISTANCE = np.radians(5.0), 0.2
GAUGE = "views: joint turn of the mirrors about the line where their planes meet"
# Corners this far from where the description has them, in widths of a view, call for another
# reading of it; one that brings them this much nearer is right.
FAR_OFF, MUCH_NEARER = 0.15, 0.4
# Sizes of the rig relative to the description that are tried, for squares of a wrong size.
SCALES = (1.0, 0.5, 0.65, 0.8, 1.25, 1.6, 2.0)
# Images that a start is judged by.
START_IMAGES = 8


def calibrate_mirror_rig(
    frames: Sequence[NDArray[np.uint8]],
    target: BoardTarget,
    sensor: SensorDescription,
    on_progress: Progress = silent,
) -> CalibrationOutcome:
    """Camera and mirrors of a mirror_stereo sensor from frames of a board without the gel.

    frames: whole camera frames (H, W) or (H, W, 3) uint8, in which both mirrors show the board.
    The fit starts at the description and keeps what the frames do not tell.  In particular two
    reflections make a turn about the line where the mirrors meet: to turn both mirrors about that
    line by some angle, and what is seen by twice that angle, changes no frame.  That one turn stays
    where the description has it, and so does the gel's pose T_camera_gel, which a calibration with
    the gel refines; distances between points that both views see do not depend on either.

    Raises CalibrationError for no frames or a sensor without two mirrors, FrameError for frames of
    another type.
    """
    model, camera, placements = _mirror_model(sensor)
    if not len(frames):
        msg = "board: found no frames, expected some"
        raise CalibrationError(msg)
    images = look_for_board(
        dict.fromkeys(placements, frames),
        target,
        on_progress,
        cut=lambda view, frame: split_frame(frame, placements[view]),
        size=(sensor.image.width, sensor.image.height),
    )
    found = findings_of_images(images)
    if any(item.severity is Severity.ERROR for item in found):
        return refused(found)
    on_progress("fitting camera and mirrors", 0, 1)
    seen = corners_of(images, placements)
    prior = _prior(model, camera, sensor)
    start, error = _start(model, camera, target, seen)
    far = FAR_OFF * next(iter(placements.values())).width
    if error > far and _start(_exchanged(model), camera, target, seen)[1] < MUCH_NEARER * error:
        return refused([*found, findings_of.of_swapped_views()])
    fit = fit_rig(model, start, target, seen, prior)
    if fit is None:
        return refused([*found, findings_of.of_no_fit()])
    on_progress("fitting camera and mirrors", 1, 1)
    residuals = residuals_of(fit, placements)
    estimates = estimates_of(model.names, prior.mean, fit.bundle, prior)
    calibrated = _calibrated(sensor, model, fit.bundle.shared)
    record = record_of(fit, residuals, estimates, (GAUGE,))
    calibrated = replace(calibrated, calibration=record)
    found += findings_of.of_residuals(residuals)
    infos, shown = {}, {}
    try:
        views, rectified = build_views(calibrated), Rectification(calibrated)
        infos = {view: rectified.info(view) for view in views}
        shown = {view: views[view].project(sensor.pattern.corners()) for view in views}
    except CmpTactileError as error:
        found.append(findings_of.of_unusable(str(error)))
    if not findings_of.residuals_are_bad(residuals):
        found += findings_of.of_directions(fit.bundle, {"camera.fx": 0, "camera.fy": 1})
        found += findings_of.of_square(target, _changes_of_lengths(model, prior.mean, fit))
        found += findings_of.of_coverage(residuals, shown) if shown else []
    fitted = estimates, residuals, len(fit.bundle.poses)
    return outcome_of(calibrated if infos else None, infos, fitted, found)


def _mirror_model(
    sensor: SensorDescription,
) -> tuple[MirrorRig, Camera, dict[str, ViewPlacement]]:
    mirrors: dict[str, Mirror] = {}
    placements = {}
    for view, description in sensor.views.items():
        roi = description.roi
        placements[view] = ViewPlacement(roi.x, roi.y, roi.width, roi.height, flipped=True)
        if description.mirror is not None:
            mirrors[view] = description.mirror
    if sensor.camera is None or len(mirrors) != 2:
        msg = (
            f"{sensor.name}: optics.type: found {sensor.optics.type} with {len(mirrors)} mirrors, "
            f"expected mirror_stereo with two; plain cameras are calibrated each by its images"
        )
        raise CalibrationError(msg)
    return MirrorRig(sensor.camera.model, mirrors), sensor.camera, placements


def _prior(model: MirrorRig, camera: Camera, sensor: SensorDescription) -> Prior:
    width = sensor.image.width
    std = [FOCAL * camera.fx, FOCAL * camera.fy, CENTRE * width, CENTRE * width]
    bend = (RADIAL, RADIAL, TANGENTIAL, TANGENTIAL, RADIAL)
    std += bend if camera.model == "pinhole" else (RADIAL,) * 4
    for mirror in model.mirrors.values():
        std += [TILT, TILT, DISTANCE * max(abs(mirror.distance), 1e-3)]
    return Prior(model.start(camera), np.array(std))


def _start(
    model: MirrorRig,
    camera: Camera,
    target: BoardTarget,
    seen: Mapping[int, Mapping[str, Corners]],
) -> tuple[NDArray[np.float64], float]:
    """The description's parameters and how far off they are, px.

    Scaled to other lengths where that fits far better: from there a fit finds its way even where
    the squares have another size than is said.
    """
    some = dict(list(seen.items())[:START_IMAGES])
    starts = [model.scaled(model.start(camera), scale) for scale in SCALES]
    errors = [start_error(model, start, target, some) for start in starts]
    best = int(np.argmin(errors))
    chosen = best if errors[best] < MUCH_NEARER * errors[0] else 0
    return starts[chosen], errors[chosen]


def _exchanged(model: MirrorRig) -> MirrorRig:
    """The rig with each mirror in the other's view."""
    mirrors = reversed(list(model.mirrors.values()))
    return MirrorRig(model.model, dict(zip(model.mirrors, mirrors, strict=True)))


def _calibrated(
    sensor: SensorDescription, model: MirrorRig, shared: NDArray[np.float64]
) -> SensorDescription:
    views = {
        view: replace(description, mirror=model.mirror(shared, view))
        for view, description in sensor.views.items()
    }
    return replace(sensor, camera=model.camera(shared), views=views)


def _changes_of_lengths(model: MirrorRig, before: NDArray[np.float64], fit: RigFit) -> list[float]:
    """After over before: baseline and distances of the mirrors."""
    after = _lengths(model, fit.bundle.shared)
    return [a / b for a, b in zip(after, _lengths(model, before), strict=True)]


def _lengths(model: MirrorRig, shared: NDArray[np.float64]) -> list[float]:
    mirrors = [model.mirror(shared, view) for view in model.mirrors]
    first, second = (2 * mirror.distance * mirror.normal for mirror in mirrors)
    return [float(np.linalg.norm(first - second)), *(abs(item.distance) for item in mirrors)]
