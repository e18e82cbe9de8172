"""Frames with truth from a folder of PNG and NPZ files, as an independent renderer writes them.

The folder holds sensor.yaml and, in subfolders, NAME.png with NAME.npz: corners_VIEW_px
(rows, cols, 2), row_lines_VIEW_px (rows, points, 2) and col_lines_VIEW_px (cols, points, 2) in px
of the whole frame, where each line's corners have the same number of points between them.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.measured.grid import Grid, GridShape, Status, ViewPlacement
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.hard_frames.case import PatternFrame

__all__ = ["load_sample", "sample_names"]


def sample_names(folder: Path, kind: str) -> list[str]:
    """Names of the frames in a subfolder of it, in order: "still/rest", ..."""
    return [f"{kind}/{path.stem}" for path in sorted((folder / kind).glob("*.npz"))]


def load_sample(sensor: SensorDescription, folder: Path, name: str) -> PatternFrame:
    """The frame of that name; FrameError where its image or truth cannot be read."""
    image = cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
    if image is None:
        msg = f"{folder / name}.png: found no readable image, expected a grey PNG"
        raise FrameError(msg)
    with np.load(folder / f"{name}.npz", allow_pickle=False) as arrays:
        truth = {
            view: _grid(sensor.pattern.shape, arrays, view, geometry.placement)
            for view, geometry in build_views(sensor).items()
        }
    visible = {view: np.isfinite(grid.corners[..., 0]) for view, grid in truth.items()}
    return PatternFrame(name, sensor, np.asarray(image, np.uint8), truth, visible, visible)


def _grid(
    shape: GridShape, arrays: dict[str, NDArray[np.float64]], view: str, place: ViewPlacement
) -> Grid:
    corners, rows, cols = (
        place.from_frame(arrays[f"{key}_{view}_px"])
        for key in ("corners", "row_lines", "col_lines")
    )
    row_lines, col_lines = _between(rows, shape.cols), _between(cols, shape.rows).swapaxes(0, 1)
    grid = Grid.missing(replace(shape, points_per_segment=row_lines.shape[2]), "", place)
    return replace(
        grid,
        corners=corners,
        corner_status=np.full_like(grid.corner_status, Status.MEASURED),
        row_lines=row_lines,
        row_line_status=np.full_like(grid.row_line_status, Status.MEASURED),
        col_lines=np.ascontiguousarray(col_lines),
        col_line_status=np.full_like(grid.col_line_status, Status.MEASURED),
    )


def _between(lines: NDArray[np.float64], corners: int) -> NDArray[np.float64]:
    """Points between the corners, (n, corners - 1, k, 2), of lines (n, points, 2)."""
    step = (lines.shape[1] - 1) // (corners - 1)
    return lines[:, :-1].reshape(len(lines), corners - 1, step, 2)[:, :, 1:]
