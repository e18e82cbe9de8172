#!/usr/bin/env python3
"""Calibrate from photographs of a board, and compare with OpenCV's calibration.

FOLDER holds OpenCV's chessboard pairs (left01.jpg ... right14.jpg and left_intrinsics.yml, as in
Debian's package opencv-doc, examples/data). They are not part of this repository. The tables have
the reprojection error and the intrinsics of both calibrations, each with OpenCV's corners and with
ours.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from cmp_tactile_processing.calibration.board.calibrate import calibrate_cameras, fit_cameras
from cmp_tactile_processing.calibration.board.start import Corners
from cmp_tactile_processing.calibration.board.target import BoardTarget, find_board

PHOTOGRAPHED = BoardTarget("chessboard", 9, 6, 0.025)
OUTPUT = Path("benchmark_output")
# Corners that were not left out as outliers, RMS of their residuals, and that of all corners.
RMS_COLUMNS = "used", "RMS px", "of all px"

Images = dict[int, NDArray[np.uint8]]
Found = dict[int, NDArray[np.float64]]


@dataclass(frozen=True)
class Fitted:
    """RMS reprojection error, px, corners that it is over, that of all, the camera's vector."""

    rms: float
    corners: int
    rms_of_all: float
    camera: NDArray[np.float64]


def read_images(folder: Path, side: str) -> Images:
    """Grey images of one camera by number."""
    images = {}
    for path in sorted(folder.glob(f"{side}[0-9][0-9].jpg")):
        images[int(path.stem[-2:])] = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    return images


def opencv_corners(images: Images, window: int) -> Found:
    """As OpenCV's calibration sample finds them: then cornerSubPix, (2 window + 1)^2 px."""
    found = {}
    for number, image in images.items():
        ok, corners = cv2.findChessboardCorners(image, (9, 6))
        if ok:
            criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
            corners = cv2.cornerSubPix(image, corners, (window, window), (-1, -1), criteria)
            found[number] = corners.reshape(-1, 2).astype(np.float64)
    return found


def sector_corners(images: Images) -> Found:
    """Those of findChessboardCornersSB."""
    flags = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE
    found = {}
    for number, image in images.items():
        ok, corners = cv2.findChessboardCornersSB(image, (9, 6), flags=flags)
        if ok:
            found[number] = corners.reshape(-1, 2).astype(np.float64)
    return found


def our_corners(images: Images) -> Found:
    """Those of this package."""
    found = {}
    for number, image in images.items():
        board = find_board(image, PHOTOGRAPHED)
        if board is not None and len(board.number) == PHOTOGRAPHED.count:
            found[number] = board.pixels
    return found


def opencv_camera(found: Found) -> Fitted:
    """cv2.calibrateCamera."""
    points = PHOTOGRAPHED.points.astype(np.float32)
    pixels = [q.astype(np.float32)[:, None] for q in found.values()]
    rms, K, distortion, _, _ = cv2.calibrateCamera(
        [points] * len(found), pixels, (640, 480), np.eye(3), np.zeros(5)
    )
    values = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.ravel(distortion)[:5]])
    return Fitted(rms, len(found) * len(points), rms, values)


def our_camera(found: Found) -> Fitted:
    """Our fit of one camera."""
    numbers = np.arange(PHOTOGRAPHED.count)
    images = {number: {"left": Corners(numbers, q)} for number, q in found.items()}
    fitted = fit_cameras("pinhole", PHOTOGRAPHED, images, {"left": (640, 480)})
    if fitted is None:
        raise SystemExit("the corners fit no camera")
    rig, fit = fitted
    residuals = fit.bundle.residuals
    used = np.concatenate([r[ok] for r, ok in zip(residuals, fit.bundle.used, strict=True)])
    lengths, of_all = np.linalg.norm(used, axis=1), 2**0.5 * np.concatenate(residuals)
    rms, rms_of_all = (float(np.sqrt((r**2).mean())) for r in (lengths, of_all))
    (view,) = rig.views(fit.bundle.fit.values).values()
    lens = view.lens
    values = np.array([*lens.matrix[[0, 1], [0, 1]], *lens.matrix[:2, 2], *lens.distortion])
    return Fitted(rms, len(lengths), rms_of_all, values)


def photographs(folder: Path, console: Console) -> None:
    """Tables of OpenCV's chessboard pairs."""
    images = {side: read_images(folder, side) for side in ("left", "right")}
    if not all(images.values()):
        raise SystemExit(f"{folder}: found no left*.jpg and right*.jpg, expected OpenCV's pairs")
    finders = {
        "classic, cornerSubPix 23 px": lambda i: opencv_corners(i, 11),
        "classic, cornerSubPix 11 px": lambda i: opencv_corners(i, 5),
        "findChessboardCornersSB": sector_corners,
        "ours": our_corners,
    }
    found = {name: {s: find(images[s]) for s in images} for name, find in finders.items()}
    table = Table(title="One camera: reprojection error")
    for heading in ("camera", "corners", "fit", "images", *RMS_COLUMNS, "fx", "fy", "cx", "cy"):
        table.add_column(heading)
    for side in images:
        for name, sides in found.items():
            for fit, fitted in (
                ("OpenCV", opencv_camera(sides[side])),
                ("ours", our_camera(sides[side])),
            ):
                row = [side, name, fit, str(len(sides[side])), str(fitted.corners)]
                row += [f"{fitted.rms:.4f}", f"{fitted.rms_of_all:.4f}"]
                row += [*(f"{v:.2f}" for v in fitted.camera[:4])]
                table.add_row(*row)
    console.print(table)
    _published(folder, console)
    numbers = sorted(images["left"].keys() & images["right"].keys())
    lists = [[images[side][k] for k in numbers] for side in ("left", "right")]
    console.print(calibrate_cameras(lists[0], lists[1], PHOTOGRAPHED).verdict)


def _published(folder: Path, console: Console) -> None:
    path = folder / "left_intrinsics.yml"
    if not path.is_file():
        return
    stored = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    K = stored.getNode("camera_matrix").mat()
    error = stored.getNode("avg_reprojection_error").real()
    values = ", ".join(f"{value:.2f}" for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    console.print(f"left_intrinsics.yml: fx fy cx cy = {values}; RMS {error:.4f} px")


def main() -> None:
    """Run what the command line asks for."""
    given = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    given.add_argument("folder", type=Path, help="folder of OpenCV's chessboard pairs")
    console = Console(width=130, record=True)
    photographs(given.parse_args().folder, console)
    OUTPUT.mkdir(exist_ok=True)
    console.save_text(str(OUTPUT / "board_calibration.txt"))


if __name__ == "__main__":
    main()
