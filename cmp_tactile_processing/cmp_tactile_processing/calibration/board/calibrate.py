"""Calibration from images of a board, before the gel is mounted: of mirrors or of plain cameras.

The board is looked for in every image, then camera and rig are fitted to all images together
(bundle adjustment); what is wrong with images or result is said in words.  An outcome with an ERROR
must not be used; where the images themselves do not serve, nothing is fitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration import outcome
from cmp_tactile_processing.calibration.board import bundle, result
from cmp_tactile_processing.calibration.board.images import (
    BoardImages,
    corners_of,
    findings_of_images,
    look_for_board,
)
from cmp_tactile_processing.calibration.board.start import (
    Corners,
    RigFit,
    fit_rig,
    start_error,
    start_of_cameras,
)
from cmp_tactile_processing.calibration.board.target import BoardTarget
from cmp_tactile_processing.errors import CalibrationError, CmpTactileError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.rectification import Rectification
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import ViewPlacement
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Camera, Mirror

MODELS = ("pinhole", "equidistant")
# Points that an image is to be covered with, per side, without its outermost tenth.
COVERAGE_POINTS = 9
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


def calibrate_cameras(  # noqa: PLR0913, PLR0917 - two lists of images are two arguments
    left_images: Sequence[NDArray[np.uint8]],
    right_images: Sequence[NDArray[np.uint8]] | None,
    target: BoardTarget,
    on_progress: outcome.Progress = outcome.silent,
    sensor: SensorDescription | None = None,
    model: str = "pinhole",
) -> outcome.CalibrationOutcome:
    """One or two plain cameras from images of a board.

    left_images, right_images: (H, W) or (H, W, 3) uint8; image k of both was taken at one time, and
    the board may be missing in one of them.  right_images is None for one camera.
    sensor: a two_view description; its cameras and its right camera's pose are replaced; the
    left camera's pose in it stays.  Images are then the views: their parts of the frame.
    model: pinhole (plumb_bob) or equidistant; that of the sensor where there is one.

    Without a sensor nothing shows the true size of the squares: one that is off by a factor makes
    the baseline off by it, and shows nowhere else.

    Raises CalibrationError for no images, lists of different lengths, a model or a sensor of
    another kind, FrameError for images of another type.
    """
    given = {"left": left_images} | ({} if right_images is None else {"right": right_images})
    _check_lists(given)
    views = tuple(given)
    before = None if sensor is None else _known(sensor, views)
    if sensor is not None:
        model = next(view.camera.model for view in sensor.views.values() if view.camera is not None)
    if model not in MODELS:
        msg = f"camera model: found {model}, expected {' or '.join(MODELS)}"
        raise CalibrationError(msg)
    images = look_for_board(given, target, on_progress)
    found = findings_of_images(images)
    if sensor is not None:
        _check_sizes(sensor, images.sizes)
    if outcome.errors_in(found):
        return result.refused(found)
    on_progress("fitting the cameras", 0, 1)
    cameras, seen = bundle.CameraPair(model, views), corners_of(images)
    fit = fit_rig(cameras, start_of_cameras(cameras, target, seen, images.sizes), target, seen)
    if fit is None:
        return result.refused([*found, result.of_no_fit()])
    on_progress("fitting the cameras", 1, 1)
    residuals = result.residuals_of(fit)
    unknown = np.full(len(cameras.names), np.nan)
    estimates = result.estimates_of(
        cameras.names, unknown if before is None else before, fit.bundle, None
    )
    found += result.of_residuals(residuals)
    if not result.residuals_are_bad(residuals):
        found += _findings_of_fit(cameras, fit, residuals, (images, before))
    fitted = estimates, residuals, len(fit.bundle.poses)
    shared = fit.bundle.shared
    if sensor is None:
        models = {view: cameras.camera(shared, view) for view in views}
        T_right_left = cameras.view_pose(shared, views[-1])
        infos = result.plain_camera_infos(models, images.sizes, T_right_left)
        return result.outcome_of(None, infos, fitted, found)
    record = result.record_of(fit, residuals, estimates)
    calibrated = replace(_calibrated(sensor, cameras, shared), calibration=record)
    try:
        rectified = Rectification(calibrated)
        infos = {view: rectified.info(view) for view in calibrated.views}
    except CmpTactileError as error:
        return result.outcome_of(None, {}, fitted, [*found, result.of_unusable(str(error))])
    return result.outcome_of(calibrated, infos, fitted, found)


def _check_lists(given: Mapping[str, Sequence[NDArray[np.uint8]]]) -> None:
    counts = {view: len(images) for view, images in given.items()}
    if not min(counts.values()):
        msg = f"board: found {counts} images, expected some"
        raise CalibrationError(msg)
    if len(set(counts.values())) > 1:
        found = " and ".join(f"{count} {view}" for view, count in counts.items())
        msg = f"board: found {found} images, expected pairs of images taken at the same time"
        raise CalibrationError(msg)


def _known(sensor: SensorDescription, views: tuple[str, ...]) -> NDArray[np.float64]:
    """The parameters that a two_view description has now."""
    cameras = [sensor.views[view].camera for view in views if view in sensor.views]
    poses = [sensor.views[view].T_view_gel for view in views if view in sensor.views]
    values, shown = [], [camera for camera in cameras if camera is not None]
    left, right = (*poses, None)[:2]
    if len(shown) != 2 or left is None or right is None or len({c.model for c in shown}) > 1:
        msg = (
            f"{sensor.name}: optics.type: found {sensor.optics.type} for {len(views)} lists of "
            f"images, expected two_view with cameras of one model and images of both"
        )
        raise CalibrationError(msg)
    for view, camera in zip(views, shown, strict=True):
        roi = sensor.views[view].roi
        values.append(
            bundle.camera_vector(replace(camera, cx=camera.cx - roi.x, cy=camera.cy - roi.y))
        )
    T = right @ np.linalg.inv(left)
    return np.concatenate([*values, cv2.Rodrigues(T[:3, :3])[0].ravel(), T[:3, 3]])


def _check_sizes(sensor: SensorDescription, sizes: Mapping[str, tuple[int, int]]) -> None:
    for view, (width, height) in sizes.items():
        roi = sensor.views[view].roi
        if (width, height) != (roi.width, roi.height):
            msg = (
                f"{view} images: found {width} x {height} px, expected those of views.{view}.roi, "
                f"{roi.width} x {roi.height}"
            )
            raise CalibrationError(msg)


def _calibrated(
    sensor: SensorDescription, model: bundle.CameraPair, shared: NDArray[np.float64]
) -> SensorDescription:
    """The description with both cameras, and the right one where it is to the left one."""
    views, T_left_gel = {}, np.asarray(sensor.views["left"].T_view_gel)
    for view in model.views:
        roi, camera = sensor.views[view].roi, model.camera(shared, view)
        in_frame = replace(camera, cx=camera.cx + roi.x, cy=camera.cy + roi.y)
        T_view_gel = model.view_pose(shared, view) @ T_left_gel
        views[view] = replace(sensor.views[view], camera=in_frame, T_view_gel=T_view_gel)
    return replace(sensor, views=views)


def _findings_of_fit(
    model: bundle.CameraPair,
    fit: RigFit,
    residuals: Sequence[outcome.ViewResiduals],
    context: tuple[BoardImages, NDArray[np.float64] | None],
) -> list[outcome.Finding]:
    images, before = context
    shared, names = fit.bundle.shared, model.names
    focal = {name: names.index(name) for name in names if name.endswith((".fx", ".fy"))}
    found = result.of_directions(fit.bundle, focal)
    found += result.of_coverage(residuals, {v: _lattice(images.sizes[v]) for v in model.views})
    if len(model.views) < 2:
        return found
    T = model.view_pose(shared, "right")
    expected = np.eye(4) if before is None else model.view_pose(before, "right")
    way, known = _centre(T), _centre(expected)
    if before is None:
        # A right camera is to the right, unless the cameras stand one above the other.
        known = np.array([abs(way[0]) if abs(way[0]) > abs(way[1]) else 0.0, 0.0, 0.0])
    if way @ known < 0:
        return [*found, result.of_swapped_views()]
    if before is not None:
        ratio = float(np.linalg.norm(way) / np.linalg.norm(known))
        found += result.of_square(images.target, [ratio])
    return found


def _centre(T_view_reference: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where a camera is (3,), reference frame, m."""
    return np.asarray(-T_view_reference[:3, :3].T @ T_view_reference[:3, 3])


def _lattice(size: tuple[int, int]) -> NDArray[np.float64]:
    """Points (n, 2) px all over an image but for its outermost tenth."""
    share = np.linspace(0.1, 0.9, COVERAGE_POINTS)
    return np.stack(np.meshgrid(share * size[0], share * size[1]), axis=-1).reshape(-1, 2)


def calibrate_mirror_rig(
    frames: Sequence[NDArray[np.uint8]],
    target: BoardTarget,
    sensor: SensorDescription,
    on_progress: outcome.Progress = outcome.silent,
) -> outcome.CalibrationOutcome:
    """Camera and mirrors of a mirror_stereo sensor from frames of a board without the gel.

    frames: whole camera frames (H, W) or (H, W, 3) uint8, in which both mirrors show the board.
    The fit starts at the description and keeps what the frames do not show.  In particular two
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
    if outcome.errors_in(found):
        return result.refused(found)
    on_progress("fitting camera and mirrors", 0, 1)
    seen = corners_of(images, placements)
    prior = _prior(model, camera, sensor)
    start, error = _start(model, camera, target, seen)
    far = FAR_OFF * next(iter(placements.values())).width
    if error > far and _start(_exchanged(model), camera, target, seen)[1] < MUCH_NEARER * error:
        return result.refused([*found, result.of_swapped_views()])
    fit = fit_rig(model, start, target, seen, prior)
    if fit is None:
        return result.refused([*found, result.of_no_fit()])
    on_progress("fitting camera and mirrors", 1, 1)
    residuals = result.residuals_of(fit, placements)
    estimates = result.estimates_of(model.names, prior.mean, fit.bundle, prior)
    calibrated = _calibrated_rig(sensor, model, fit.bundle.shared)
    record = result.record_of(fit, residuals, estimates, (GAUGE,))
    calibrated = replace(calibrated, calibration=record)
    found += result.of_residuals(residuals)
    infos, shown = {}, {}
    try:
        views, rectified = build_views(calibrated), Rectification(calibrated)
        infos = {view: rectified.info(view) for view in views}
        shown = {view: views[view].project(sensor.pattern.corners()) for view in views}
    except CmpTactileError as error:
        found.append(result.of_unusable(str(error)))
    if not result.residuals_are_bad(residuals):
        found += result.of_directions(fit.bundle, {"camera.fx": 0, "camera.fy": 1})
        found += result.of_square(target, _changes_of_lengths(model, prior.mean, fit))
        found += result.of_coverage(residuals, shown) if shown else []
    fitted = estimates, residuals, len(fit.bundle.poses)
    return result.outcome_of(calibrated if infos else None, infos, fitted, found)


def _mirror_model(
    sensor: SensorDescription,
) -> tuple[bundle.MirrorRig, Camera, dict[str, ViewPlacement]]:
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
    return bundle.MirrorRig(sensor.camera.model, mirrors), sensor.camera, placements


def _prior(model: bundle.MirrorRig, camera: Camera, sensor: SensorDescription) -> bundle.Prior:
    width = sensor.image.width
    std = [FOCAL * camera.fx, FOCAL * camera.fy, CENTRE * width, CENTRE * width]
    bend = (RADIAL, RADIAL, TANGENTIAL, TANGENTIAL, RADIAL)
    std += bend if camera.model == "pinhole" else (RADIAL,) * 4
    for mirror in model.mirrors.values():
        std += [TILT, TILT, DISTANCE * max(abs(mirror.distance), 1e-3)]
    return bundle.Prior(model.start(camera), np.array(std))


def _start(
    model: bundle.MirrorRig,
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


def _exchanged(model: bundle.MirrorRig) -> bundle.MirrorRig:
    """The rig with each mirror in the other's view."""
    mirrors = reversed(list(model.mirrors.values()))
    return bundle.MirrorRig(model.model, dict(zip(model.mirrors, mirrors, strict=True)))


def _calibrated_rig(
    sensor: SensorDescription, model: bundle.MirrorRig, shared: NDArray[np.float64]
) -> SensorDescription:
    views = {
        view: replace(description, mirror=model.mirror(shared, view))
        for view, description in sensor.views.items()
    }
    return replace(sensor, camera=model.camera(shared), views=views)


def _changes_of_lengths(
    model: bundle.MirrorRig, before: NDArray[np.float64], fit: RigFit
) -> list[float]:
    """After over before: baseline and distances of the mirrors."""
    after = _lengths(model, fit.bundle.shared)
    return [a / b for a, b in zip(after, _lengths(model, before), strict=True)]


def _lengths(model: bundle.MirrorRig, shared: NDArray[np.float64]) -> list[float]:
    mirrors = [model.mirror(shared, view) for view in model.mirrors]
    first, second = (2 * mirror.distance * mirror.normal for mirror in mirrors)
    return [float(np.linalg.norm(first - second)), *(abs(item.distance) for item in mirrors)]
