"""Draws the gridlines that were found into the image they were found in."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.grid import Grid, Status

__all__ = ["draw_grid"]

# BGR.
ROW_COLOUR = (80, 200, 255)
COL_COLOUR = (255, 180, 60)
CORNER_COLOURS = {Status.MEASURED: (60, 220, 60), Status.PREDICTED: (60, 60, 255)}
ORIGIN_COLOUR = (255, 0, 255)
# OpenCV's fixed-point coordinates: 4 fractional bits.
SHIFT = 4
CORNER_RADIUS_PX = 2.0
ORIGIN_RADIUS_PX = 5.0


def draw_grid(image: NDArray[np.uint8], grid: Grid) -> NDArray[np.uint8]:
    """The grey view (H, W) as BGR (H, W, 3), with rows, columns and corners of the grid.

    Corners that were measured are green, those that were predicted red, corner (0, 0) has a ring;
    a line is broken where a point is missing.
    """
    canvas = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    rows = _chains(grid.corners, grid.row_lines)
    cols = _chains(grid.corners.swapaxes(0, 1), grid.col_lines.swapaxes(0, 1))
    _draw_segments(canvas, rows, ROW_COLOUR)
    _draw_segments(canvas, cols, COL_COLOUR)
    for status, colour in CORNER_COLOURS.items():
        _draw_dots(canvas, grid.corners[grid.corner_status == status], CORNER_RADIUS_PX, colour)
    _draw_dots(canvas, grid.corners[0, :1], ORIGIN_RADIUS_PX, ORIGIN_COLOUR, filled=False)
    return canvas


def _chains(corners: NDArray[np.float64], between: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points along each line in order, (lines, points, 2): a corner, its virtual markers, ..."""
    lines, last = corners.shape[0], corners[:, -1:]
    segments = np.concatenate([corners[:, :-1, None], between], axis=2)
    return np.concatenate([segments.reshape(lines, -1, 2), last], axis=1)


def _draw_segments(
    canvas: NDArray[np.uint8], chains: NDArray[np.float64], colour: tuple[int, int, int]
) -> None:
    segments = np.stack([chains[:, :-1], chains[:, 1:]], axis=2).reshape(-1, 2, 2)
    drawable = _fixed_point(segments[_inside(segments, canvas).all(axis=1)])
    cv2.polylines(canvas, list(drawable), False, colour, 1, cv2.LINE_AA, SHIFT)


def _draw_dots(
    canvas: NDArray[np.uint8],
    centres: NDArray[np.float64],
    radius_px: float,
    colour: tuple[int, int, int],
    *,
    filled: bool = True,
) -> None:
    radius = round(radius_px * (1 << SHIFT))
    for x, y in _fixed_point(centres[_inside(centres, canvas)]).tolist():
        cv2.circle(canvas, (x, y), radius, colour, cv2.FILLED if filled else 1, cv2.LINE_AA, SHIFT)


def _inside(points: NDArray[np.float64], canvas: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Which points (..., 2) are near enough to the image to be drawn; NaN is not."""
    height, width = canvas.shape[:2]
    x, y = points[..., 0], points[..., 1]
    return np.asarray((x > -width) & (x < 2 * width) & (y > -height) & (y < 2 * height))


def _fixed_point(points: NDArray[np.float64]) -> NDArray[np.int32]:
    return np.round(points * (1 << SHIFT)).astype(np.int32)
