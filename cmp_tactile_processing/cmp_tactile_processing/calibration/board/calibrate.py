"""Calibration from images of a board, before the gel is mounted: of mirrors or of plain cameras.

The board is looked for in every image, then camera and rig are fitted to all images together
(bundle adjustment); what is wrong with images or result is said in words.  An outcome with an ERROR
must not be used; where the images themselves do not serve, nothing is fitted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration import outcome
from cmp_tactile_processing.calibration.board import bundle, result
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
from cmp_tactile_processing.calibration.outcome import Finding, Progress, Severity
from cmp_tactile_processing.errors import CalibrationError, CmpTactileError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.rectification import Rectification
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import ViewPlacement
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Camera, Mirror

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


def corners_of(
    images: BoardImages, placements: Mapping[str, ViewPlacement] | None = None
) -> dict[int, dict[str, Corners]]:
    """Corners by image and view; in pixels of the frame where a view is a part of one."""
    return {
        image: {
            view: Corners(
                item.number, placements[view].to_frame(item.pixels) if placements else item.pixels
            )
            for view, item in views.items()
        }
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
