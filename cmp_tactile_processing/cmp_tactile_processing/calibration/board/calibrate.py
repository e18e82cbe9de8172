"""Calibration from images of a board, before the gel is mounted: of mirrors or of plain cameras.

The board is looked for in every image, then camera and rig are fitted to all images together
(bundle adjustment); what is wrong with images or result is said in words.  An outcome with an ERROR
must not be used; where the images themselves do not serve, nothing is fitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration import outcome
from cmp_tactile_processing.calibration.board import result
from cmp_tactile_processing.calibration.board.images import (
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
from cmp_tactile_processing.calibration.map_fit import MapFit, central_jacobian
from cmp_tactile_processing.calibration.outcome import Estimate, finding, rig_estimates
from cmp_tactile_processing.errors import CalibrationError, CmpTactileError, Finding, errors_in
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.rectification import Rectification
from cmp_tactile_processing.geometry.rig_parameters import RigParameters, RigPrior
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.processes import OnProgress, no_progress
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.parts import Camera, Optics, Roi, ViewDescription

MODELS = ("pinhole", "equidistant")
# Points that an image is to be covered with, per side, without its outermost tenth.
COVERAGE_POINTS = 9
# How far a mirror rig may be from its description: standard deviations, relative, of the frame's
# width, of each coefficient of distortion, rad, relative.
FOCAL, CENTRE, BEND = 0.1, 0.1, 0.5
TILT, DISTANCE = float(np.radians(5.0)), 0.2
# How far plain cameras may be from what OpenCV makes of their images, each by itself: so far that
# the images alone count.
UNKNOWN_CAMERAS = RigPrior(
    turn=0.5, shift=0.1, focal=0.5, aspect=0.1, principal_point=200.0, distortion=1.0
)
GAUGE = "views: common rotation of the mirrors about the line where their planes meet"
# Corners this far from where the description has them, in widths of a view, call for another
# reading of it; one that brings them this much nearer is right.
FAR_OFF, MUCH_NEARER = 0.15, 0.4
# Sizes of the rig relative to the description that are tried, for squares of a wrong size.
SCALES = (1.0, 0.5, 0.65, 0.8, 1.25, 1.6, 2.0)
# Images that a start is judged by.
START_IMAGES = 8
# The way over which a derivative is taken, in deviations of a prior.
STEP = 1e-4


def calibrate_cameras(  # noqa: PLR0913, PLR0917 - two lists of images are two arguments
    left_images: Sequence[NDArray[np.uint8]],
    right_images: Sequence[NDArray[np.uint8]] | None,
    target: BoardTarget,
    on_progress: OnProgress = no_progress,
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
    if sensor is not None:
        model = _check_two_view(sensor, len(given))
    if model not in MODELS:
        msg = f"camera model: found {model}, expected {' or '.join(MODELS)}"
        raise CalibrationError(msg)
    images = look_for_board(given, target, on_progress)
    found = findings_of_images(images)
    if sensor is not None:
        _check_sizes(sensor, images.sizes)
    if errors_in(found):
        return result.refused(found)
    on_progress("fitting the cameras", 0.0)
    fitted_rig = fit_cameras(model, target, corners_of(images), images.sizes, sensor)
    if fitted_rig is None:
        return result.refused([*found, finding("no fit", error=True)])
    rig, fit = fitted_rig
    on_progress("fitting the cameras", 1.0)
    residuals = result.residuals_of(fit)
    calibrated = rig.sensor(fit.bundle.fit.values)
    estimates = _pair_estimates(rig, fit.bundle.fit, sensor)
    found += result.of_residuals(residuals)
    if not result.residuals_are_bad(residuals):
        found += result.of_directions(fit.bundle.poses, estimates)
        lattices = {view: _lattice(size) for view, size in images.sizes.items()}
        found += result.of_coverage(residuals, lattices)
        found += _findings_of_pair(sensor, calibrated, target)
    fitted = estimates, residuals, len(fit.bundle.poses)
    if sensor is None:
        infos = result.plain_camera_infos(calibrated, images.sizes)
        return result.outcome_of(None, infos, fitted, found)
    record = result.record_of(fit, residuals, estimates)
    calibrated = replace(sensor, views=calibrated.views, calibration=record)
    try:
        rectified = Rectification(calibrated)
        infos = {view: rectified.info(view) for view in calibrated.views}
    except CmpTactileError as error:
        return result.outcome_of(
            None, {}, fitted, [*found, finding("unusable", error=True, reason=str(error))]
        )
    return result.outcome_of(calibrated, infos, fitted, found)


def fit_cameras(
    model: str,
    target: BoardTarget,
    seen: Mapping[int, Mapping[str, Corners]],
    sizes: Mapping[str, tuple[int, int]],
    sensor: SensorDescription | None = None,
) -> tuple[RigParameters, RigFit] | None:
    """One or two plain cameras as a rig, and its fit; None where no image fits at all.

    seen: corners by image and view.  sizes: of each view's images, px.  sensor: see
    `calibrate_cameras`.
    """
    cameras, T_right_left = start_of_cameras(model, target, seen, sizes)
    start = _start_of_pair(sensor, cameras, T_right_left, sizes)
    rig = RigParameters(start, UNKNOWN_CAMERAS, held=("views.left: gel",))
    fit = fit_rig(rig, np.zeros(len(rig.free)), target, seen)
    return None if fit is None else (rig, fit)


def _check_lists(given: Mapping[str, Sequence[NDArray[np.uint8]]]) -> None:
    counts = {view: len(images) for view, images in given.items()}
    if not min(counts.values()):
        msg = f"board: found {counts} images, expected at least one"
        raise CalibrationError(msg)
    if len(set(counts.values())) > 1:
        found = " and ".join(f"{count} {view}" for view, count in counts.items())
        msg = f"board: found {found} images, expected pairs of images taken at the same time"
        raise CalibrationError(msg)


def _check_two_view(sensor: SensorDescription, count: int) -> str:
    """The camera model of a two_view description; CalibrationError for another one."""
    views = sensor.views.values()
    models = {view.camera.model for view in views if view.camera and view.T_view_gel is not None}
    if count != 2 or len(sensor.views) != 2 or len(models) != 1 or sensor.optics.type != "two_view":
        msg = (
            f"{sensor.name}: optics.type: found {sensor.optics.type} for {count} lists of images, "
            "expected two_view, with images of both cameras and one camera model"
        )
        raise CalibrationError(msg)
    return models.pop()


def _check_sizes(sensor: SensorDescription, sizes: Mapping[str, tuple[int, int]]) -> None:
    for view, (width, height) in sizes.items():
        roi = sensor.views[view].roi
        if (width, height) != (roi.width, roi.height):
            msg = (
                f"{view} images: found {width} x {height} px, expected those of views.{view}.roi, "
                f"{roi.width} x {roi.height}"
            )
            raise CalibrationError(msg)


def _start_of_pair(
    sensor: SensorDescription | None,
    cameras: Mapping[str, Camera],
    T_right_left: NDArray[np.float64],
    sizes: Mapping[str, tuple[int, int]],
) -> SensorDescription:
    """A two_view description with these cameras, of which nothing but its optics is used.

    The gel frame is that of the description or, without one, the left camera's.
    """
    if sensor is None:
        views = {
            name: ViewDescription(Roi(0, 0, *size), T_view_gel=np.eye(4))
            for name, size in sizes.items()
        }
        sensor = replace(load_sensor("prototype"), views=views)
    T_left_gel, views = np.asarray(sensor.views["left"].T_view_gel), {}
    for name, camera in cameras.items():
        roi = sensor.views[name].roi
        in_frame = replace(camera, cx=camera.cx + roi.x, cy=camera.cy + roi.y)
        pose = T_left_gel if name == "left" else T_right_left @ T_left_gel
        views[name] = replace(sensor.views[name], camera=in_frame, T_view_gel=pose)
    return replace(sensor, camera=None, optics=Optics("two_view", None, ()), views=views)


def _pair_estimates(
    rig: RigParameters, fit: MapFit, sensor: SensorDescription | None
) -> tuple[Estimate, ...]:
    """The cameras' values, before as described, and how far two cameras are apart."""
    known = {} if sensor is None else {item.name: item.before for item in RigParameters(sensor).all}
    found = [
        replace(item, before=known.get(item.name, np.nan))
        for item in rig_estimates(rig, fit)
        if ".camera." in item.name
    ]
    views = rig.sensor(fit.values).views
    if len(views) == 2:

        def baseline(changes: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.array([np.linalg.norm(_way(rig.sensor(changes)))])

        slope = central_jacobian(baseline, fit.values, STEP * rig.prior_std)
        std = float(np.sqrt(slope @ fit.covariance @ slope.T)[0, 0])
        before = np.nan if sensor is None else float(np.linalg.norm(_way(sensor)))
        after = float(baseline(fit.values)[0])
        found.append(Estimate("baseline", "m", before, after, std, determined=True))
    return tuple(found)


def _way(sensor: SensorDescription) -> NDArray[np.float64]:
    """From the left camera of a two_view description to the right one (3,), left frame, m."""
    T_left_gel, T_right_gel = (np.asarray(sensor.views[v].T_view_gel) for v in ("left", "right"))
    return np.asarray((T_left_gel @ np.linalg.inv(T_right_gel))[:3, 3])


def _findings_of_pair(
    sensor: SensorDescription | None, calibrated: SensorDescription, target: BoardTarget
) -> list[Finding]:
    """Are views exchanged, or squares of another size?"""
    if len(calibrated.views) < 2:
        return []
    way = _way(calibrated)
    if sensor is not None:
        known = _way(sensor)
    else:
        # A right camera is to the right, unless the cameras stand one above the other.
        known = np.array([abs(way[0]) if abs(way[0]) > abs(way[1]) else 0.0, 0.0, 0.0])
    if way @ known < 0:
        return [finding("board swapped", error=True)]
    if sensor is None:
        return []
    return result.of_square(target, [float(np.linalg.norm(way) / np.linalg.norm(known))])


def _lattice(size: tuple[int, int]) -> NDArray[np.float64]:
    """Points (n, 2) px all over an image but for its outermost tenth."""
    share = np.linspace(0.1, 0.9, COVERAGE_POINTS)
    return np.stack(np.meshgrid(share * size[0], share * size[1]), axis=-1).reshape(-1, 2)


def calibrate_mirror_rig(
    frames: Sequence[NDArray[np.uint8]],
    target: BoardTarget,
    sensor: SensorDescription,
    on_progress: OnProgress = no_progress,
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
    rig = _mirror_rig(sensor)
    if not len(frames):
        msg = "board: found no frames, expected at least one"
        raise CalibrationError(msg)
    described = rig.views(np.zeros(len(rig.free)))
    images = look_for_board(
        dict.fromkeys(described, frames),
        target,
        on_progress,
        cut=lambda view, frame: split_frame(frame, described[view].placement),
        size=sensor.frame_size,
    )
    found = findings_of_images(images)
    if errors_in(found):
        return result.refused(found)
    on_progress("fitting camera and mirrors", 0.0)
    seen = corners_of(images)
    start, error = _start(rig, target, seen)
    far = FAR_OFF * next(iter(described.values())).placement.width
    if error > far and _start(_exchanged(sensor), target, seen)[1] < MUCH_NEARER * error:
        return result.refused([*found, finding("board swapped", error=True)])
    fit = fit_rig(rig, start, target, seen)
    if fit is None:
        return result.refused([*found, finding("no fit", error=True)])
    on_progress("fitting camera and mirrors", 1.0)
    residuals = result.residuals_of(fit)
    estimates = [
        item for item in rig_estimates(rig, fit.bundle.fit) if not item.name.startswith("gel")
    ]
    optics = rig.sensor(fit.bundle.fit.values)
    record = result.record_of(fit, residuals, estimates, (GAUGE,))
    calibrated = replace(
        sensor,
        camera=optics.camera,
        views=optics.views,
        calibration=record,
        uncertainty=sensor.uncertainty.updated(rig.names, fit.bundle.fit.covariance),
    )
    found += result.of_residuals(residuals)
    infos, shown = {}, {}
    try:
        views, rectified = build_views(calibrated), Rectification(calibrated)
        infos = {view: rectified.info(view) for view in views}
        shown = {view: views[view].project(sensor.pattern.corners()) for view in views}
    except CmpTactileError as error:
        found.append(finding("unusable", error=True, reason=str(error)))
    if not result.residuals_are_bad(residuals):
        found += result.of_directions(fit.bundle.poses, estimates)
        ratios = [b / a for a, b in zip(_lengths(sensor), _lengths(calibrated), strict=True)]
        found += result.of_square(target, ratios)
        found += result.of_coverage(residuals, shown) if shown else []
    fitted = estimates, residuals, len(fit.bundle.poses)
    return result.outcome_of(calibrated if infos else None, infos, fitted, found)


def _mirror_rig(sensor: SensorDescription) -> RigParameters:
    """Camera and mirrors, of a rig without its gel; CalibrationError for one of another kind."""
    mirrors = [view.mirror for view in sensor.views.values() if view.mirror is not None]
    if sensor.camera is None or len(mirrors) != 2:
        msg = (
            f"{sensor.name}: optics.type: found {sensor.optics.type} with {len(mirrors)} mirrors, "
            "expected mirror_stereo with two; for cameras without mirrors give the images of each"
        )
        raise CalibrationError(msg)
    prior = RigPrior(
        turn=TILT,
        shift=DISTANCE * float(np.mean([abs(mirror.distance) for mirror in mirrors])),
        focal=FOCAL,
        aspect=FOCAL,
        principal_point=CENTRE * sensor.image.width,
        distortion=BEND,
    )
    without_gel = replace(sensor, optics=replace(sensor.optics, layers=()))
    return RigParameters(without_gel, prior, held=("gel",))


def _start(
    rig: RigParameters, target: BoardTarget, seen: Mapping[int, Mapping[str, Corners]]
) -> tuple[NDArray[np.float64], float]:
    """Changes of the description to start at, and how far off they are, px.

    Scaled to other lengths where that fits far better: from there a fit finds its way even where
    the squares have another size than is said.
    """
    some = dict(list(seen.items())[:START_IMAGES])
    distances = {
        item.name: item.before for item in rig.free if item.name.endswith(".mirror.distance")
    }
    starts = [
        np.array([(scale - 1) * distances.get(name, 0.0) for name in rig.names]) for scale in SCALES
    ]
    errors = [start_error(rig.views(start), target, some) for start in starts]
    best = int(np.argmin(errors))
    chosen = best if errors[best] < MUCH_NEARER * errors[0] else 0
    return starts[chosen], errors[chosen]


def _exchanged(sensor: SensorDescription) -> RigParameters:
    """The rig with each mirror in the other's view."""
    mirrors = [view.mirror for view in sensor.views.values()][::-1]
    views = {
        name: replace(view, mirror=mirror)
        for (name, view), mirror in zip(sensor.views.items(), mirrors, strict=True)
    }
    return _mirror_rig(replace(sensor, views=views))


def _lengths(sensor: SensorDescription) -> list[float]:
    """Baseline and distances of the mirrors, m."""
    mirrors = [view.mirror for view in sensor.views.values() if view.mirror is not None]
    first, second = (2 * mirror.distance * mirror.normal for mirror in mirrors)
    return [float(np.linalg.norm(first - second)), *(abs(item.distance) for item in mirrors)]
