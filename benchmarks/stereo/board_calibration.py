#!/usr/bin/env python3
"""Calibration from images of a board, against OpenCV's own and against the truth.

--data FOLDER: OpenCV's chessboard pairs (left01.jpg ... right14.jpg and left_intrinsics.yml, as in
Debian's package opencv-doc, examples/data): reprojection error and intrinsics of OpenCV's
calibration and of ours, each on OpenCV's corners and on ours; the images are not part of this
repository.  Without it, simulated mirror rigs alone: errors by number of images.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from cmp_tactile_processing.calibration.board.bundle import CameraPair
from cmp_tactile_processing.calibration.board.calibrate import (
    calibrate_cameras,
    calibrate_mirror_rig,
)
from cmp_tactile_processing.calibration.board.start import Corners, fit_rig, start_of_cameras
from cmp_tactile_processing.calibration.board.target import BoardTarget, find_board
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_simulation.hard_frames.changed_rig import (
    board_poses,
    changed_rig,
    photograph_board,
)
from cmp_tactile_simulation.rendering.camera import CameraSettings

PHOTOGRAPHED = BoardTarget("chessboard", 9, 6, 0.025)
SIMULATED = BoardTarget("chessboard", 9, 6, 1.2e-3)
NOISE = 4.0
DISTORTION = (-0.1, 0.02, 1e-3, -5e-4, 0.0)
COUNTS = (4, 6, 8, 12, 15, 20)
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


def our_rig(sides: Mapping[str, Found]) -> tuple[dict[str, Fitted], float]:
    """Our joint fit of one or two cameras, and the baseline, m."""
    model = CameraPair("pinhole", tuple(sides))
    numbers = np.arange(PHOTOGRAPHED.count)
    images: dict[int, dict[str, Corners]] = {}
    for side, found in sides.items():
        for number, q in found.items():
            images.setdefault(number, {})[side] = Corners(numbers, q)
    sizes = dict.fromkeys(sides, (640, 480))
    start = start_of_cameras(model, PHOTOGRAPHED, images, sizes)
    fit = fit_rig(model, start, PHOTOGRAPHED, images)
    if fit is None:
        raise SystemExit("the corners fit no camera")
    fitted = {}
    for place, side in enumerate(sides):
        chosen = [k for k, item in enumerate(fit.observations) if item.view == side]
        used = [fit.bundle.residuals[k][fit.bundle.used[k]] for k in chosen]
        lengths = np.linalg.norm(np.concatenate(used), axis=1)
        camera = fit.bundle.shared[9 * place : 9 * place + 9]
        of_all = np.concatenate([fit.bundle.residuals[k] for k in chosen])
        rms, rms_of_all = (float(np.sqrt((r**2).mean())) for r in (lengths, 2**0.5 * of_all))
        fitted[side] = Fitted(rms, len(lengths), rms_of_all, camera)
    baseline = float(np.linalg.norm(fit.bundle.shared[-3:])) if len(sides) == 2 else float("nan")
    return fitted, baseline


def opencv_pair(sides: Mapping[str, Found]) -> tuple[float, int, float]:
    """cv2.stereoCalibrate from each camera's own calibration: RMS, corners, baseline."""
    both = sorted(sides["left"].keys() & sides["right"].keys())
    points = [PHOTOGRAPHED.points.astype(np.float32)] * len(both)
    pixels = {s: [f[k].astype(np.float32)[:, None] for k in both] for s, f in sides.items()}
    cameras = [opencv_camera(found).camera for found in sides.values()]
    lenses = []
    for values in cameras:
        K = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1]])
        lenses += [K, values[4:]]
    rms, _, _, _, _, _, t, _, _ = cv2.stereoCalibrate(
        points, pixels["left"], pixels["right"], *lenses, (640, 480),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
    )  # fmt: skip
    # OpenCV's is over both cameras' corners.
    return rms, 2 * len(both) * PHOTOGRAPHED.count, float(np.linalg.norm(t))


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
                ("ours", our_rig({"left": sides[side]})[0]["left"]),
            ):
                row = [side, name, fit, str(len(sides[side])), str(fitted.corners)]
                row += [f"{fitted.rms:.4f}", f"{fitted.rms_of_all:.4f}"]
                row += [*(f"{v:.2f}" for v in fitted.camera[:4])]
                table.add_row(*row)
    console.print(table)
    _published(folder, console)
    _pairs(found, console)
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


def _pairs(found: Mapping[str, Mapping[str, Found]], console: Console) -> None:
    table = Table(title="Both cameras together, images in which both see the board")
    for heading in ("corners", "fit", *RMS_COLUMNS, "baseline mm"):
        table.add_column(heading)
    for name, sides in found.items():
        both = sides["left"].keys() & sides["right"].keys()
        shared = {side: {k: q for k, q in f.items() if k in both} for side, f in sides.items()}
        rms, count, baseline = opencv_pair(shared)
        values = f"{rms:.4f}", f"{rms:.4f}", f"{1e3 * baseline:.3f}"
        table.add_row(name, "OpenCV", str(count), *values)
        fitted, baseline = our_rig(shared)
        count = sum(item.corners for item in fitted.values())
        rms = np.sqrt(sum(item.rms**2 * item.corners for item in fitted.values()) / count)
        of_all = np.sqrt(np.mean([item.rms_of_all**2 for item in fitted.values()]))
        values = f"{rms:.4f}", f"{of_all:.4f}", f"{1e3 * baseline:.3f}"
        table.add_row(name, "ours", str(count), *values)
    console.print(table)


def simulated(seeds: int, console: Console) -> None:
    """Table of mirror rigs that are off their description by 1 degree, 0.5 mm and 1 %."""
    described = load_sensor("sample_rig")
    table = Table(title=f"Simulated mirror rigs, noise {NOISE:g}: median (worst) of {seeds}")
    for heading in ("images", "length error %", "focal error %", "RMS px"):
        table.add_column(heading)
    rows: dict[int, list[tuple[float, float, float]]] = {count: [] for count in COUNTS}
    for seed in range(seeds):
        rig = changed_rig(described, seed)
        if rig.camera is None:
            continue
        rig = replace(rig, camera=replace(rig.camera, distortion=DISTORTION))
        frames = [
            photograph_board(rig, SIMULATED, T, CameraSettings(read_noise=NOISE), k)
            for k, T in enumerate(board_poses(rig, SIMULATED, max(COUNTS), seed))
        ]
        for count in COUNTS:
            result = _errors(rig, described, frames[:count])
            if result is not None:
                rows[count].append(result)
    for count, results in rows.items():
        if not results:
            table.add_row(str(count), "refused", "refused", "")
            continue
        middle, worst = np.median(results, axis=0), np.max(results, axis=0)
        cells = [f"{100 * middle[k]:.4f} ({100 * worst[k]:.4f})" for k in (0, 1)]
        table.add_row(str(count), *cells, f"{middle[2]:.4f}")
    console.print(table)


def _errors(
    rig: SensorDescription, described: SensorDescription, frames: Sequence[NDArray[np.uint8]]
) -> tuple[float, float, float] | None:
    outcome = calibrate_mirror_rig(frames, SIMULATED, described)
    found = outcome.sensor
    if found is None or found.camera is None or rig.camera is None or found.calibration is None:
        return None
    focal = abs(found.camera.fx / rig.camera.fx - 1)
    return _length_error(rig, found), focal, found.calibration.reprojection


def _length_error(true: SensorDescription, found: SensorDescription) -> float:
    """RMS relative error of lengths above 3 mm between points about the gel."""
    p = np.random.default_rng(5).uniform(-5e-3, 5e-3, (1000, 3)) * (1, 1, 0.3)
    views, models = build_views(true), build_views(found)
    rays = [models[name].rays(view.project(p)) for name, view in views.items()]
    (o1, v1), (o2, v2) = rays
    way, cosine = o2 - o1, (v1 * v2).sum(axis=1)
    along1, along2 = (way * v1).sum(axis=1), (way * v2).sum(axis=1)
    t1 = (along1 - cosine * along2) / (1 - cosine**2)
    t2 = (cosine * along1 - along2) / (1 - cosine**2)
    q = (o1 + t1[:, None] * v1 + o2 + t2[:, None] * v2) / 2
    length = np.linalg.norm(p - np.roll(p, 1, axis=0), axis=1)
    ratio = np.linalg.norm(q - np.roll(q, 1, axis=0), axis=1) / length - 1
    return float(np.sqrt((ratio[length > 3e-3] ** 2).mean()))


def main() -> None:
    """Run what the command line asks for."""
    given = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    given.add_argument("--data", type=Path, help="folder of OpenCV's chessboard pairs")
    given.add_argument("--seeds", type=int, default=3, help="simulated rigs (%(default)s)")
    options = given.parse_args()
    console = Console(width=130, record=True)
    if options.data is not None:
        photographs(options.data, console)
    if options.seeds > 0:
        simulated(options.seeds, console)
    OUTPUT.mkdir(exist_ok=True)
    console.save_text(str(OUTPUT / "board_calibration.txt"))


if __name__ == "__main__":
    main()
