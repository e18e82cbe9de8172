"""Calibration from images of a board, before the gel is mounted: of mirrors or of plain cameras.

The board is looked for in every image, then camera and rig are fitted to all images together
(bundle adjustment); what is wrong with images or result is said in words.  An outcome with an ERROR
must not be used; where the images themselves do not serve, nothing is fitted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration import outcome
from cmp_tactile_processing.calibration.board import result
from cmp_tactile_processing.calibration.board.start import (
    Corners,
    RigFit,
    fit_rig,
    start_error,
    start_of_cameras,
)
from cmp_tactile_processing.calibration.board.target import (
    BoardSighting,
    BoardTarget,
    chessboard_size,
    find_board,
)
from cmp_tactile_processing.calibration.map_fit import MapFit, central_jacobian
from cmp_tactile_processing.calibration.outcome import Estimate, Finding, Progress, Severity
from cmp_tactile_processing.calibration.rig import RigParameters, RigPrior
from cmp_tactile_processing.errors import CalibrationError, CmpTactileError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.rectification import Rectification
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.parts import Camera, Optics, Roi, ViewDescription

Cut = Callable[[str, NDArray[np.uint8]], NDArray[np.uint8]]

# Different poses of the board: fewer than the first give no result, than the second a warning.
# Simulated mirror rigs are right to 0.01 % with 6 already; plain cameras, and boards that lean
# little, need more.
LEAST_POSES, ENOUGH_POSES = 6, 10
# Of those, seen in both views.
LEAST_SHARED = 4
# Corners that moved less than this between two images, px RMS, show the same pose.
SAME_POSE_PX = 1.0
# Share of the images without a board that is worth a word.
MANY_MISSING = 0.25
# Blur, in sides of a square, that hides the corners, and in blurs of the other images.
BLURRED_SIDES, BLURRED_OTHERS, LEAST_BLUR_PX = 0.14, 2.5, 1.5
# Images without the board that are looked at for another one.
PROBED = 3
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
GAUGE = "views: joint turn of the mirrors about the line where their planes meet"
# Corners this far from where the description has them, in widths of a view, call for another
# reading of it; one that brings them this much nearer is right.
FAR_OFF, MUCH_NEARER = 0.15, 0.4
# Sizes of the rig relative to the description that are tried, for squares of a wrong size.
SCALES = (1.0, 0.5, 0.65, 0.8, 1.25, 1.6, 2.0)
# Images that a start is judged by.
START_IMAGES = 8
# The way over which a derivative is taken, in deviations of a prior.
STEP = 1e-4


@dataclass(frozen=True)
class BoardImages:
    """What is seen in the images of each view; images are counted from 0, None: no board there.

    sizes: width and height by view, px; None where no image could be used.
    other_size: names of images of another size, with it.  other_board: inner corners (cols, rows)
    of another chessboard seen.
    """

    target: BoardTarget
    sightings: dict[str, list[BoardSighting | None]]
    sizes: dict[str, tuple[int, int]]
    other_size: tuple[str, ...] = ()
    other_board: tuple[int, int] | None = None

    @property
    def count(self) -> int:
        """Number of images of a view, that of pairs for two."""
        return max((len(seen) for seen in self.sightings.values()), default=0)

    @property
    def seen(self) -> dict[int, dict[str, BoardSighting]]:
        """Sightings by image and view; images without any are left out."""
        found: dict[int, dict[str, BoardSighting]] = {}
        for view, sightings in self.sightings.items():
            for image, sighting in enumerate(sightings):
                if sighting is not None:
                    found.setdefault(image, {})[view] = sighting
        return dict(sorted(found.items()))


def corners_of(images: BoardImages) -> dict[int, dict[str, Corners]]:
    """Corners by image and view."""
    return {
        image: {view: Corners(item.number, item.pixels) for view, item in views.items()}
        for image, views in images.seen.items()
    }


def look_for_board(
    images: dict[str, Sequence[NDArray[np.uint8]]],
    target: BoardTarget,
    on_progress: Progress,
    cut: Cut | None = None,
    size: tuple[int, int] | None = None,
) -> BoardImages:
    """Look for the board in the images of each view.

    images: by view; the same frames for all views where `cut` takes a view's part out of a frame,
    un-mirrored.  size: width and height that images must have, default that of most of a view's.
    """
    total = sum(len(of_view) for of_view in images.values())
    done, sightings, sizes, others = 0, {}, {}, []
    without: list[NDArray[np.uint8]] = []
    for view, of_view in images.items():
        wanted = size or _most_common_size(of_view)
        found: list[BoardSighting | None] = []
        for number, image in enumerate(of_view):
            on_progress("looking for the board", done, total)
            done += 1
            if image.shape[1::-1] != wanted:
                name = f"image {number + 1}" if cut else f"{view} image {number + 1}"
                others.append(f"{name} ({image.shape[1]} x {image.shape[0]})")
                found.append(None)
                continue
            part = cut(view, image) if cut else image
            found.append(find_board(part, target, view))
            if found[-1] is None and len(without) < PROBED:
                without.append(part)
            sizes[view] = part.shape[1], part.shape[0]
        sightings[view] = found
    on_progress("looking for the board", total, total)
    board = _other_board(target, without) if _few(sightings) else None
    return BoardImages(target, sightings, sizes, tuple(dict.fromkeys(others)), board)


def _most_common_size(images: Sequence[NDArray[np.uint8]]) -> tuple[int, int]:
    return Counter(image.shape[1::-1] for image in images).most_common(1)[0][0]


def _few(sightings: dict[str, list[BoardSighting | None]]) -> bool:
    """Whether a view shows the board in less than half of its images."""
    return any(
        2 * sum(item is not None for item in found) < len(found) for found in sightings.values()
    )


def _other_board(
    target: BoardTarget, images: Sequence[NDArray[np.uint8]]
) -> tuple[int, int] | None:
    """The chessboard of another size that images show most often."""
    sizes = [size for image in images if (size := chessboard_size(image)) is not None]
    own = max(target.cols, target.rows), min(target.cols, target.rows)
    others = Counter(size for size in sizes if size != own)
    return others.most_common(1)[0][0] if others and target.kind == "chessboard" else None


def findings_of_images(images: BoardImages) -> list[Finding]:
    """What is wrong with the images themselves, before anything is fitted."""
    findings = _of_sizes(images) + _of_missing(images)
    seen, repeated = images.seen, _repeated(images)
    distinct = len(seen) - len(repeated)
    if repeated:
        text = (
            f"{len(repeated)} of {len(seen)} images show the board where another one shows it "
            f"already, which leaves {distinct} poses."
        )
        advice = "Move and lean the board between images; many images of one pose say no more."
        findings.append(Finding.graded(text, advice, error=distinct < LEAST_POSES))
    findings += _of_count(images, distinct)
    return findings + _of_blur(images)


def _of_sizes(images: BoardImages) -> list[Finding]:
    if not images.other_size:
        return []
    sizes = sorted({f"{width} x {height}" for width, height in images.sizes.values()})
    text = f"Images of another size were left out: {', '.join(images.other_size)}."
    if sizes:
        text = text[:-1] + f"; views are {' and '.join(sizes)} px."
    advice = "Take all images with the one camera, at the resolution that the sensor will run at."
    return [Finding.graded(text, advice, error=not images.sizes)]


def _of_missing(images: BoardImages) -> list[Finding]:
    findings = []
    if images.other_board is not None:
        cols, rows = images.other_board
        text = (
            f"Images show a chessboard of {cols} x {rows} inner corners, not of "
            f"{images.target.cols} x {images.target.rows}."
        )
        advice = f"Count inner corners, not squares; if the board is right, give {cols}x{rows}."
        return [Finding(Severity.ERROR, text, advice)]
    for view, sightings in images.sightings.items():
        missing = [number + 1 for number, item in enumerate(sightings) if item is None]
        if len(missing) <= MANY_MISSING * len(sightings):
            continue
        none = len(missing) == len(sightings)
        text = f"The board was not found in {len(missing)} of {len(sightings)} {view} images"
        text += "." if none else f": {_listed(missing)}."
        advice = (
            "The whole chessboard with a white margin, or most of a ChArUco board, must be seen, "
            "evenly lit and sharp; check the number of corners"
        )
        if images.target.kind == "charuco":
            advice += ", the dictionary, and whether the image is mirrored"
        findings.append(Finding.graded(text, advice + ".", error=none))
    return findings


def _of_count(images: BoardImages, distinct: int) -> list[Finding]:
    findings = []
    advice = (
        f"Take {ENOUGH_POSES} to 20 images with the board in different places, leaning by 20 to 40 "
        f"degrees to all sides."
    )
    if distinct < ENOUGH_POSES:
        few = distinct < LEAST_POSES
        text = f"{distinct} different poses of the board are "
        text += f"too few: at least {LEAST_POSES} are needed." if few else "few."
        findings.append(Finding.graded(text, advice, error=few))
    if len(images.sightings) == 2 and distinct >= LEAST_POSES:
        both = sum(len(views) == 2 for views in images.seen.values())
        if both < LEAST_SHARED:
            text = (
                f"Both views show the board in {both} images; their places relative to each other "
                f"need at least {LEAST_SHARED}."
            )
            advice = "Hold the board where both views see it."
            findings.append(Finding(Severity.ERROR, text, advice))
    return findings


def _of_blur(images: BoardImages) -> list[Finding]:
    blurs = {
        (view, image): (sighting.blur_px, sighting.side_px)
        for image, views in images.seen.items()
        for view, sighting in views.items()
        if np.isfinite(sighting.blur_px)
    }
    if not blurs:
        return []
    usual = float(np.median([blur for blur, _ in blurs.values()]))
    blurred = sorted(
        {
            image + 1
            for (_, image), (blur, side) in blurs.items()
            if blur > LEAST_BLUR_PX and blur > min(BLURRED_SIDES * side, BLURRED_OTHERS * usual)
        }
    )
    if not blurred:
        return []
    text = f"Images are blurred: {_listed(blurred)} (edges of usually {usual:.1f} px)."
    advice = "Hold the board still while the image is taken, light it well, and check the focus."
    return [Finding(Severity.WARNING, text, advice)]


def _repeated(images: BoardImages) -> list[int]:
    """Images that show the board where an earlier one does, in all views."""
    kept: list[dict[str, BoardSighting]] = []
    repeated = []
    for image, views in images.seen.items():
        if any(_same_pose(views, earlier) for earlier in kept):
            repeated.append(image)
        else:
            kept.append(views)
    return repeated


def _same_pose(a: dict[str, BoardSighting], b: dict[str, BoardSighting]) -> bool:
    return a.keys() == b.keys() and all(_moved_px(a[view], b[view]) < SAME_POSE_PX for view in a)


def _moved_px(a: BoardSighting, b: BoardSighting) -> float:
    """RMS way of the corners that both show, px; infinite without any."""
    _, at_a, at_b = np.intersect1d(a.number, b.number, return_indices=True)
    if not len(at_a):
        return float("inf")
    return float(np.sqrt(((a.pixels[at_a] - b.pixels[at_b]) ** 2).sum(axis=1).mean()))


def _listed(numbers: Sequence[int], most: int = 8) -> str:
    listed = ", ".join(str(number) for number in numbers[:most])
    return listed if len(numbers) <= most else f"{listed} and {len(numbers) - most} more"


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
    if sensor is not None:
        model = _check_two_view(sensor, len(given))
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
    fitted_rig = fit_cameras(model, target, corners_of(images), images.sizes, sensor)
    if fitted_rig is None:
        return result.refused([*found, result.of_no_fit()])
    rig, fit = fitted_rig
    on_progress("fitting the cameras", 1, 1)
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
        return result.outcome_of(None, {}, fitted, [*found, result.of_unusable(str(error))])
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
        msg = f"board: found {counts} images, expected some"
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
            f"{sensor.name}: optics.type: found {sensor.optics.type} for {count} lists of "
            f"images, expected two_view with cameras of one model and images of both"
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
        for item in rig.estimates(fit)
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
        return [result.of_swapped_views()]
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
    rig = _mirror_rig(sensor)
    if not len(frames):
        msg = "board: found no frames, expected some"
        raise CalibrationError(msg)
    described = rig.views(np.zeros(len(rig.free)))
    images = look_for_board(
        dict.fromkeys(described, frames),
        target,
        on_progress,
        cut=lambda view, frame: split_frame(frame, described[view].placement),
        size=(sensor.image.width, sensor.image.height),
    )
    found = findings_of_images(images)
    if outcome.errors_in(found):
        return result.refused(found)
    on_progress("fitting camera and mirrors", 0, 1)
    seen = corners_of(images)
    start, error = _start(rig, target, seen)
    far = FAR_OFF * next(iter(described.values())).placement.width
    if error > far and _start(_exchanged(sensor), target, seen)[1] < MUCH_NEARER * error:
        return result.refused([*found, result.of_swapped_views()])
    fit = fit_rig(rig, start, target, seen)
    if fit is None:
        return result.refused([*found, result.of_no_fit()])
    on_progress("fitting camera and mirrors", 1, 1)
    residuals = result.residuals_of(fit)
    estimates = [item for item in rig.estimates(fit.bundle.fit) if not item.name.startswith("gel")]
    optics = rig.sensor(fit.bundle.fit.values)
    record = result.record_of(fit, residuals, estimates, (GAUGE,))
    calibrated = replace(sensor, camera=optics.camera, views=optics.views, calibration=record)
    found += result.of_residuals(residuals)
    infos, shown = {}, {}
    try:
        views, rectified = build_views(calibrated), Rectification(calibrated)
        infos = {view: rectified.info(view) for view in views}
        shown = {view: views[view].project(sensor.pattern.corners()) for view in views}
    except CmpTactileError as error:
        found.append(result.of_unusable(str(error)))
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
            f"expected mirror_stereo with two; plain cameras are calibrated each by its images"
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
