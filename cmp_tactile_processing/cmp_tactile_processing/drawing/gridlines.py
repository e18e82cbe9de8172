"""Gridlines, markers and faults, drawn into the image of a view."""

from __future__ import annotations

import textwrap

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured import (
    Grid,
    GridFault,
    NumberingKind,
    Status,
    gridline_points,
)

# BGR.
ROW_COLOUR = (80, 200, 255)
COL_COLOUR = (255, 180, 60)
CORNER_COLOURS = {Status.MEASURED: (60, 220, 60), Status.PREDICTED: (0, 140, 255)}
ABSENT_COLOUR = (60, 60, 255)
ORIGIN_COLOUR = (255, 0, 255)
TEXT_COLOUR, OUTLINE_COLOUR = (255, 255, 255), (0, 0, 0)
# Of a line's colour; the rest is the image, whose edges are to be seen beneath.
LINE_OPACITY = 0.45
# OpenCV's fixed-point coordinates: 4 fractional bits.
SHIFT = 4
# Pixels of the dot of a corner, 5 px across.
CORNER_DOT = np.array([(x, y) for y in range(-2, 3) for x in range(-2, 3) if x * x + y * y < 5])
ORIGIN_RADIUS_PX = 5.0
CROSS_PX = 7
FONT, FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.45
CHARACTER_PX, LINE_PX, TEXT_MARGIN_PX = 8, 17, 8


def draw_grid(image: NDArray[np.uint8], grid: Grid) -> NDArray[np.uint8]:
    """The view, grey (H, W) or BGR (H, W, 3), as BGR with all that the grid holds.

    Corners that were measured are green dots, those that were predicted orange; a red cross shows
    where a corner next to them is missing; corner (0, 0) has a ring.  Lines through the virtual
    markers are pale and end where a point is missing; the markers on them are dots.  Beneath stand
    the number of corners, confidence, fault and reason.
    """
    if image.ndim == 2:
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR).astype(np.uint8, copy=False)
    canvas: NDArray[np.uint8] = image.copy()
    rows = gridline_points(grid.corners, grid.row_lines)
    cols = gridline_points(grid.corners.swapaxes(0, 1), grid.col_lines.swapaxes(0, 1))
    _draw_lines(canvas, rows, ROW_COLOUR)
    _draw_lines(canvas, cols, COL_COLOUR)
    cv2.addWeighted(canvas, LINE_OPACITY, image, 1 - LINE_OPACITY, 0.0, dst=canvas)
    _draw_points(canvas, grid.row_lines, ROW_COLOUR)
    _draw_points(canvas, grid.col_lines, COL_COLOUR)
    _draw_crosses(canvas, _absent_corners(grid.corners), ABSENT_COLOUR)
    for status, colour in CORNER_COLOURS.items():
        _draw_pixels(canvas, grid.corners[grid.corner_status == status], CORNER_DOT, colour)
    _draw_ring(canvas, grid.corners[0, :1], ORIGIN_COLOUR)
    _write(canvas, grid)
    return canvas


def _absent_corners(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where missing corners (n, 2) would be that continue two others of their row or column."""
    rows, cols = corners.shape[:2]
    around = np.full((rows + 4, cols + 4, 2), np.nan)
    around[2:-2, 2:-2] = corners
    near = np.stack(
        [
            2 * around[2 + i : rows + 2 + i, 2 + j : cols + 2 + j]
            - around[2 + 2 * i : rows + 2 + 2 * i, 2 + 2 * j : cols + 2 + 2 * j]
            for i, j in ((0, 1), (0, -1), (1, 0), (-1, 0))
        ]
    )
    known = np.isfinite(near).all(axis=-1, keepdims=True)
    count = known.sum(axis=0)
    mean = np.where(known, near, 0).sum(axis=0) / np.maximum(count, 1)
    return np.asarray(mean[np.isnan(corners[..., 0]) & (count[..., 0] > 0)])


def _draw_lines(
    canvas: NDArray[np.uint8], chains: NDArray[np.float64], colour: tuple[int, int, int]
) -> None:
    """Each chain in pieces between missing points: its sides one by one take twice as long."""
    near = _inside(chains, canvas)
    fixed = _fixed_point(np.where(near[..., None], chains, 0.0))
    pieces: list[NDArray[np.int32]] = []
    for chain, seen in zip(fixed, near, strict=True):
        if seen.all():
            pieces.append(chain)
        else:
            breaks = np.flatnonzero(np.diff(seen)) + 1
            runs = zip(np.split(chain, breaks), np.split(seen, breaks), strict=True)
            pieces += [run for run, kept in runs if kept[0] and len(run) > 1]
    cv2.polylines(canvas, pieces, False, colour, 1, cv2.LINE_AA, SHIFT)


def _draw_points(
    canvas: NDArray[np.uint8], points: NDArray[np.float64], colour: tuple[int, int, int]
) -> None:
    _draw_pixels(canvas, points, np.zeros((1, 2), int), colour)


def _draw_pixels(
    canvas: NDArray[np.uint8],
    points: NDArray[np.float64],
    around: NDArray[np.int_],
    colour: tuple[int, int, int],
) -> None:
    """Colour the pixels at offsets `around` (K, 2) of each point (..., 2)."""
    height, width = canvas.shape[:2]
    flat = points.reshape(-1, 2)
    nearest = np.rint(flat[_inside(flat, canvas)]).astype(int)
    x, y = (nearest[:, None] + around).reshape(-1, 2).T
    seen = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    flat_canvas = canvas.reshape(-1, 3)
    flat_canvas[y[seen] * width + x[seen]] = colour


def _draw_crosses(
    canvas: NDArray[np.uint8], centres: NDArray[np.float64], colour: tuple[int, int, int]
) -> None:
    for x, y in np.rint(centres[_inside(centres, canvas)]).astype(int).tolist():
        cv2.drawMarker(canvas, (x, y), colour, cv2.MARKER_TILTED_CROSS, CROSS_PX, 1, cv2.LINE_AA)


def _draw_ring(
    canvas: NDArray[np.uint8], centres: NDArray[np.float64], colour: tuple[int, int, int]
) -> None:
    radius = round(ORIGIN_RADIUS_PX * (1 << SHIFT))
    for x, y in _fixed_point(centres[_inside(centres, canvas)]).tolist():
        cv2.circle(canvas, (x, y), radius, colour, 1, cv2.LINE_AA, SHIFT)


def _write(canvas: NDArray[np.uint8], grid: Grid) -> None:
    """At the lower edge, outlined, to be read on light and dark."""
    measured = np.count_nonzero(grid.corner_status == Status.MEASURED)
    state = [f"{measured} of {grid.corner_status.size} corners"]
    state += [f"confidence {grid.confidence:.2f}"] if np.isfinite(grid.confidence) else []
    state += ["followed"] if grid.followed else []
    relative = grid.numbering is NumberingKind.RELATIVE
    state += ["relative numbers"] if relative else []
    trouble = grid.reason
    if grid.fault is not GridFault.NONE:
        trouble = f"{grid.fault.value}: {trouble}"
    # The font has no other characters.
    trouble = trouble.encode("ascii", "replace").decode()
    across = max((canvas.shape[1] - 2 * TEXT_MARGIN_PX) // CHARACTER_PX, 1)
    lines = [(line, ABSENT_COLOUR) for line in textwrap.wrap(trouble, across)]
    lines += [(line, TEXT_COLOUR) for line in textwrap.wrap(", ".join(state), across)]
    for number, (line, colour) in enumerate(lines):
        y = canvas.shape[0] - TEXT_MARGIN_PX - LINE_PX * (len(lines) - 1 - number)
        place = (TEXT_MARGIN_PX, y)
        cv2.putText(canvas, line, place, FONT, FONT_SCALE, OUTLINE_COLOUR, 3)
        cv2.putText(canvas, line, place, FONT, FONT_SCALE, colour, 1, cv2.LINE_AA)


def _inside(points: NDArray[np.float64], canvas: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Which points (..., 2) are near enough to the image to be drawn; NaN is not."""
    height, width = canvas.shape[:2]
    x, y = points[..., 0], points[..., 1]
    return np.asarray((x > -width) & (x < 2 * width) & (y > -height) & (y < 2 * height))


def _fixed_point(points: NDArray[np.float64]) -> NDArray[np.int32]:
    return np.round(points * (1 << SHIFT)).astype(np.int32)
