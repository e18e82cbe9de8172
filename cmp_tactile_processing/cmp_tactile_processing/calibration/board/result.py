"""From a fitted rig to the outcome of a board calibration, with what speaks against it in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.board.start import RigFit
from cmp_tactile_processing.calibration.board.target import BoardTarget
from cmp_tactile_processing.calibration.outcome import (
    CalibrationOutcome,
    Estimate,
    ViewResiduals,
    finding,
    provenance,
    reprojection,
)
from cmp_tactile_processing.errors import Finding, errors_in
from cmp_tactile_processing.geometry.rectification import ROS_MODEL, ViewCameraInfo
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import CalibrationRecord, Camera

# RMS reprojection error: good cameras and flat boards give 0.05 to 0.3 px.
HIGH_RMS_PX, BAD_RMS_PX = 0.6, 1.5
MANY_OUTLIERS, BAD_OUTLIERS = 0.1, 0.3
# Images with corners that were mostly left out.
MISFIT_SHARE = 0.5
# Standard deviation of the focal length, relative: beyond this it is not known.
VAGUE_FOCAL, UNKNOWN_FOCAL = 0.003, 0.01
FOCAL_NAMES = (".fx", ".fy / fx")
# Share of what the views are for (the gel's pattern, or the image) that corners surround.
LOW_COVERAGE, NO_COVERAGE = 0.5, 0.1
# Common change of all lengths of the rig that no rig is off by: the square is another one.
WRONG_SQUARE, DOUBTFUL_SQUARE = 0.15, 0.08
METHOD = "board"


def residuals_are_bad(residuals: Sequence[ViewResiduals]) -> bool:
    """Whether the fit is so poor that nothing further can be said of it."""
    return any(item.rms > BAD_RMS_PX or _left_out(item) > BAD_OUTLIERS for item in residuals)


def of_residuals(residuals: Sequence[ViewResiduals]) -> list[Finding]:
    """Reprojection error above the limit, outliers, and images that do not fit."""
    findings = []
    for item in residuals:
        out = _left_out(item)
        if item.rms > HIGH_RMS_PX:
            bad = item.rms > BAD_RMS_PX
            values = {
                "view": item.view,
                "rms": item.rms,
                "limit": BAD_RMS_PX if bad else HIGH_RMS_PX,
            }
            findings.append(finding("reprojection of a view", error=bad, **values))
        if out > MANY_OUTLIERS:
            values = {"share": 100 * out, "view": item.view}
            findings.append(finding("corners left out", error=out > BAD_OUTLIERS, **values))
    misfits = _misfits(residuals)
    if misfits:
        images = ", ".join(str(image + 1) for image in misfits)
        findings.append(finding("images left out", error=False, images=images))
    return findings


def _left_out(item: ViewResiduals) -> float:
    return float(1 - item.used.mean()) if item.used.size else 0.0


def _misfits(residuals: Sequence[ViewResiduals]) -> list[int]:
    found = set()
    for item in residuals:
        for image in np.unique(item.image):
            if np.mean(~item.used[item.image == image]) > MISFIT_SHARE:
                found.add(int(image))
    return sorted(found)


def of_directions(
    poses: Mapping[int, NDArray[np.float64]], estimates: Sequence[Estimate]
) -> list[Finding]:
    """Focal lengths that the images do not show.  poses: of the board, (4, 4)."""
    findings = []
    normals = np.stack([T[:3, 2] for T in poses.values()])
    mean = normals.mean(axis=0)
    lean = np.degrees(np.arccos(np.clip(normals @ mean / np.linalg.norm(mean), -1, 1)))
    for item in estimates:
        share = item.std / abs(item.after) if item.name.endswith(FOCAL_NAMES) else 0.0
        if share <= VAGUE_FOCAL:
            continue
        values = {"name": item.name, "share": 100 * share, "lean": np.median(lean)}
        findings.append(finding("one direction", error=share > UNKNOWN_FOCAL, **values))
    return findings


def of_coverage(
    residuals: Sequence[ViewResiduals], wanted: Mapping[str, NDArray[np.float64]]
) -> list[Finding]:
    """Parts of the views that no corner surrounds.

    wanted: points (..., 2) px of each view that the calibration is for.
    """
    findings = []
    for item in residuals:
        hull = cv2.convexHull(item.pixels[item.used].astype(np.float32))
        inside = [
            cv2.pointPolygonTest(hull, (float(x), float(y)), measureDist=False) >= 0
            for x, y in wanted[item.view].reshape(-1, 2)
        ]
        share = float(np.mean(inside))
        if share >= LOW_COVERAGE:
            continue
        values = {"share": 100 * share, "view": item.view}
        findings.append(finding("not covered", error=share < NO_COVERAGE, **values))
    return findings


def of_square(target: BoardTarget, ratios: Sequence[float]) -> list[Finding]:
    """A square of another size: lengths of the rig, after over before, are off by one factor."""
    logs = np.log(np.asarray(ratios, dtype=np.float64))
    if not logs.size or not np.isfinite(logs).all():
        return []
    common, spread = float(logs.mean()), float(np.ptp(logs))
    if abs(common) < DOUBTFUL_SQUARE or spread > abs(common):
        return []
    factor = float(np.exp(common))
    given = 1e3 * target.square
    values = {"factor": factor, "probable": given / factor, "given": given}
    return [finding("other squares", error=abs(common) > WRONG_SQUARE, **values)]


def residuals_of(fit: RigFit) -> tuple[ViewResiduals, ...]:
    """Residuals by view."""
    found = []
    bundle, views = fit.bundle, dict.fromkeys(item.view for item in fit.observations)
    for view in views:
        chosen = [k for k, item in enumerate(fit.observations) if item.view == view]
        pixels = np.concatenate([fit.observations[k].q for k in chosen])
        residuals = np.concatenate([bundle.residuals[k] for k in chosen])
        image = [np.full(len(fit.observations[k].q), fit.observations[k].image) for k in chosen]
        used = np.concatenate([bundle.used[k] for k in chosen])
        found.append(ViewResiduals(view, pixels, residuals, np.concatenate(image), used))
    return tuple(found)


def record_of(
    fit: RigFit,
    residuals: Sequence[ViewResiduals],
    estimates: Sequence[Estimate],
    held: Sequence[str] = (),
) -> CalibrationRecord:
    """The record that goes into a description.  held: what else kept its value."""
    return CalibrationRecord(
        method=METHOD,
        frames=len(fit.bundle.poses),
        reprojection=reprojection(residuals),
        **provenance(estimates, held),
    )


def plain_camera_infos(
    sensor: SensorDescription, sizes: Mapping[str, tuple[int, int]]
) -> dict[str, ViewCameraInfo]:
    """Camera models of one or two plain cameras, two of them with OpenCV's stereo rectification.

    sensor: a two_view description with them, whose views are whole images.
    """
    cameras = {name: view.camera for name, view in sensor.views.items() if view.camera is not None}
    matrices = {view: _matrix(camera) for view, camera in cameras.items()}
    turns = {view: np.eye(3) for view in cameras}
    projections = {view: np.column_stack([K, np.zeros(3)]) for view, K in matrices.items()}
    if len(cameras) == 2:
        T_left_gel, T_right_gel = (np.asarray(view.T_view_gel) for view in sensor.views.values())
        T_right_left = T_right_gel @ np.linalg.inv(T_left_gel)
        parts = _rectified(cameras["left"], cameras["right"], sizes["left"], T_right_left)
        turns = dict(zip(cameras, parts[:2], strict=True))
        projections = dict(zip(cameras, parts[2:], strict=True))
    return {
        view: ViewCameraInfo(
            *sizes[view],
            ROS_MODEL[camera.model],
            _distortion(camera),
            matrices[view],
            turns[view],
            projections[view],
        )
        for view, camera in cameras.items()
    }


def _rectified(
    left: Camera, right: Camera, size: tuple[int, int], T_right_left: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """R (3, 3) of both cameras, then P (3, 4) of both, by OpenCV."""
    K, D = (_matrix(left), _matrix(right)), (_distortion(left), _distortion(right))
    R, t = T_right_left[:3, :3].copy(), T_right_left[:3, 3].copy()
    parts: Sequence[object]
    if left.model == "equidistant":
        flags = cv2.fisheye.CALIB_ZERO_DISPARITY
        parts = cv2.fisheye.stereoRectify(K[0], D[0], K[1], D[1], size, R, t, flags)
    else:
        flags = cv2.CALIB_ZERO_DISPARITY
        parts = cv2.stereoRectify(K[0], D[0], K[1], D[1], size, R, t, flags=flags, alpha=0)
    return [np.asarray(part, dtype=np.float64) for part in parts[:4]]


def _matrix(camera: Camera) -> NDArray[np.float64]:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])


def _distortion(camera: Camera) -> NDArray[np.float64]:
    return np.array(camera.distortion)


def refused(findings: Sequence[Finding]) -> CalibrationOutcome:
    """The outcome of images from which nothing was fitted."""
    return CalibrationOutcome(METHOD, None, {}, (), (), tuple(findings), _refusal(findings))


def outcome_of(
    sensor: SensorDescription | None,
    cameras: Mapping[str, ViewCameraInfo],
    fitted: tuple[Sequence[Estimate], Sequence[ViewResiduals], int],
    findings: Sequence[Finding],
) -> CalibrationOutcome:
    """The outcome with its verdict.  fitted: estimates, residuals and number of images."""
    estimates, residuals, images = fitted
    if errors_in(findings):
        verdict = _refusal(findings)
    else:
        errors = " and ".join(f"{item.rms:.3f} px ({item.view})" for item in residuals)
        verdict = f"Accepted: {images} images, reprojection error {errors}."
        if findings:
            verdict += f" It could be better: {findings[0].text}"
    return CalibrationOutcome(
        METHOD, sensor, cameras, tuple(estimates), tuple(residuals), tuple(findings), verdict
    )


def _refusal(findings: Sequence[Finding]) -> str:
    first = errors_in(findings)[0]
    return f"Refused: {first.text} {first.advice}"
