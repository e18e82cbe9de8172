"""From a fitted rig to the outcome of a board calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timezone

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.board.bundle import Bundle, Prior
from cmp_tactile_processing.calibration.board.start import RigFit
from cmp_tactile_processing.calibration.map_fit import HELD_SHARE
from cmp_tactile_processing.calibration.outcome import (
    CalibrationOutcome,
    Estimate,
    Finding,
    Severity,
    ViewResiduals,
)
from cmp_tactile_processing.geometry.rectification import ROS_MODEL, ViewCameraInfo
from cmp_tactile_processing.measured.grid import ViewPlacement
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import CalibrationRecord, Camera

__all__ = [
    "estimates_of",
    "outcome_of",
    "plain_camera_infos",
    "record_of",
    "refused",
    "residuals_of",
]

METHOD = "board"
UNITS = {
    "fx": "px",
    "fy": "px",
    "cx": "px",
    "cy": "px",
    "distance": "m",
    "shift": "m",
    "tilt": "rad",
    "turn": "rad",
}


def residuals_of(
    fit: RigFit, placements: Mapping[str, ViewPlacement] | None = None
) -> tuple[ViewResiduals, ...]:
    """Residuals by view, px of the view.  placements: where the fit's pixels are of a frame."""
    found = []
    bundle, views = fit.bundle, dict.fromkeys(item.view for item in fit.observations)
    for view in views:
        chosen = [k for k, item in enumerate(fit.observations) if item.view == view]
        pixels = np.concatenate([fit.observations[k].q for k in chosen])
        residuals = np.concatenate([bundle.residuals[k] for k in chosen])
        if placements:
            pixels = placements[view].from_frame(pixels)
            if placements[view].flipped:
                residuals = residuals * (-1.0, 1.0)
        image = [np.full(len(fit.observations[k].q), fit.observations[k].image) for k in chosen]
        used = np.concatenate([bundle.used[k] for k in chosen])
        found.append(ViewResiduals(view, pixels, residuals, np.concatenate(image), used))
    return tuple(found)


def estimates_of(
    names: Sequence[str], before: NDArray[np.float64], bundle: Bundle, prior: Prior | None
) -> tuple[Estimate, ...]:
    """What the fit says of each shared parameter.  before (S,): NaN where nothing was known."""
    std = np.sqrt(np.diag(bundle.covariance).clip(0))
    known = np.full(len(names), np.inf) if prior is None else prior.std
    return tuple(
        Estimate(
            name,
            _unit(name),
            float(before[k]),
            float(bundle.shared[k]),
            float(std[k]),
            bool(std[k] <= HELD_SHARE * known[k]),
        )
        for k, name in enumerate(names)
    )


def _unit(name: str) -> str:
    words = name.replace(".", " ").split()
    return next((unit for word, unit in UNITS.items() if word in words), "")


def record_of(
    fit: RigFit,
    residuals: Sequence[ViewResiduals],
    estimates: Sequence[Estimate],
    held: Sequence[str] = (),
) -> CalibrationRecord:
    """The record that goes into a description.  held: what else kept its value."""
    determined = tuple(item.name for item in estimates if item.determined)
    kept = tuple(item.name for item in estimates if not item.determined)
    return CalibrationRecord(
        method=METHOD,
        date=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        frames=len(fit.bundle.poses),
        reprojection=_rms(residuals),
        determined=determined,
        held=(*held, *kept),
    )


def _rms(residuals: Sequence[ViewResiduals]) -> float:
    used = np.concatenate([item.residuals[item.used] for item in residuals])
    return float(np.sqrt((used**2).sum(axis=1).mean())) if len(used) else float("nan")


def plain_camera_infos(
    cameras: Mapping[str, Camera],
    sizes: Mapping[str, tuple[int, int]],
    T_right_left: NDArray[np.float64],
) -> dict[str, ViewCameraInfo]:
    """Camera models of one or two plain cameras, two of them with OpenCV's stereo rectification."""
    matrices = {view: _matrix(camera) for view, camera in cameras.items()}
    turns = {view: np.eye(3) for view in cameras}
    projections = {view: np.column_stack([K, np.zeros(3)]) for view, K in matrices.items()}
    if len(cameras) == 2:
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
    if any(item.severity is Severity.ERROR for item in findings):
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
    first = next(item for item in findings if item.severity is Severity.ERROR)
    return f"Refused: {first.text} {first.advice}"
