"""What a fitted board calibration says about the images and the rig, in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.board.bundle import Bundle
from cmp_tactile_processing.calibration.board.target import BoardTarget
from cmp_tactile_processing.calibration.outcome import Finding, Severity, ViewResiduals

__all__ = [
    "of_coverage",
    "of_directions",
    "of_no_fit",
    "of_residuals",
    "of_square",
    "of_swapped_views",
    "of_unusable",
    "residuals_are_bad",
]

# RMS reprojection error: good cameras and flat boards give 0.05 to 0.3 px.
HIGH_RMS_PX, BAD_RMS_PX = 0.6, 1.5
MANY_OUTLIERS, BAD_OUTLIERS = 0.1, 0.3
# Images whose corners were mostly left out.
MISFIT_SHARE = 0.5
# Standard deviation of the focal length, relative: beyond this it is not known.
VAGUE_FOCAL, UNKNOWN_FOCAL = 0.003, 0.01
# Share of what the views are for (the gel's pattern, or the image) that corners surround.
LOW_COVERAGE, NO_COVERAGE = 0.5, 0.1
# Common change of all lengths of the rig that no rig is off by: the square is another one.
WRONG_SQUARE, DOUBTFUL_SQUARE = 0.15, 0.08


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
            limit = BAD_RMS_PX if bad else HIGH_RMS_PX
            text = f"Reprojection error of the {item.view} view: {item.rms:.2f} px, limit {limit}."
            advice = (
                "Check that the board is flat and rigid, the camera model right, and that board "
                "and camera stood still."
            )
            findings.append(Finding(Severity.ERROR if bad else Severity.WARNING, text, advice))
        if out > MANY_OUTLIERS:
            severity = Severity.ERROR if out > BAD_OUTLIERS else Severity.WARNING
            text = f"{100 * out:.0f} % of the {item.view} view's corners do not fit the others."
            advice = "Look at the plot of residuals; leave out images that stand apart."
            findings.append(Finding(severity, text, advice))
    misfits = _misfits(residuals)
    if misfits:
        text = f"Images do not fit the others: {', '.join(str(image + 1) for image in misfits)}."
        advice = "The board moved between the two views or is not the same: leave them out."
        findings.append(Finding(Severity.WARNING, text, advice))
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


def of_directions(bundle: Bundle, focal: Mapping[str, int]) -> list[Finding]:
    """Focal lengths that the images do not tell; focal: index of each in the shared parameters."""
    findings = []
    normals = np.stack([T[:3, 2] for T in bundle.poses.values()])
    mean = normals.mean(axis=0)
    lean = np.degrees(np.arccos(np.clip(normals @ mean / np.linalg.norm(mean), -1, 1)))
    for name, index in focal.items():
        share = float(np.sqrt(bundle.covariance[index, index]) / bundle.shared[index])
        if share <= VAGUE_FOCAL:
            continue
        unknown = share > UNKNOWN_FOCAL
        text = (
            f"{name} is known to {100 * share:.2g} % only: the board was seen from about one "
            f"direction (it leans by {np.median(lean):.0f} degrees from its mean)."
        )
        advice = "Lean the board by 20 to 40 degrees to all sides, and near and far."
        findings.append(Finding(Severity.ERROR if unknown else Severity.WARNING, text, advice))
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
        text = (
            f"The board covers {100 * share:.0f} % of the part of the {item.view} view that is to "
            f"be measured in."
        )
        advice = "Take images with the board in every part of the view, its corners included."
        severity = Severity.ERROR if share < NO_COVERAGE else Severity.WARNING
        findings.append(Finding(severity, text, advice))
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
    text = (
        f"All lengths of the rig come out {factor:.2f} times those of the sensor description: the "
        f"squares are probably {1e3 * target.square / factor:.3g} mm, not "
        f"{1e3 * target.square:.3g} mm."
    )
    advice = (
        "Measure the squares over many of them and give their side; if it is right, the lengths "
        "in the sensor description are wrong."
    )
    severity = Severity.ERROR if abs(common) > WRONG_SQUARE else Severity.WARNING
    return [Finding(severity, text, advice)]


def of_swapped_views() -> Finding:
    """The left view is the right one."""
    text = "The views are swapped: what is called the left view looks from the right."
    advice = "Exchange the two folders or topics, or the two views in the sensor description."
    return Finding(Severity.ERROR, text, advice)


def of_no_fit() -> Finding:
    """Nothing fits."""
    text = "The images do not fit the rig at all: no pose of the board explains any of them."
    advice = "Check which images belong to which view, the number of corners and the description."
    return Finding(Severity.ERROR, text, advice)


def of_unusable(reason: str) -> Finding:
    """The calibrated description cannot be used."""
    text = f"With what was found the sensor cannot work: {reason}."
    advice = "Check squares and views first; then whether the description is of this sensor."
    return Finding(Severity.ERROR, text, advice)
