"""Colours, words, arrows, outlines and gridlines of what was measured, for RViz and the browser."""

from __future__ import annotations

import math
import textwrap

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.force.advice import SLIP_WORDS
from cmp_tactile_processing.force.grasp import GraspState
from cmp_tactile_processing.measured import (
    Contact,
    Grid,
    GridFault,
    NumberingKind,
    SlipState,
    Status,
    gridline_points,
)

# Digits after the point of forces, N.
LEAST_DIGITS, MOST_DIGITS = 2, 4
MESH_ALPHA = 0.85
DISPLACEMENT_COLOUR = (1.0, 1.0, 1.0, 1.0)
FORCE_COLOUR = (1.0, 0.25, 0.1, 1.0)
UNKNOWN_COLOUR = (0.75, 0.85, 1.0, 1.0)
LEGEND_COLOUR = (0.9, 0.9, 0.9, 1.0)
SLIP_COLOURS = {
    SlipState.UNKNOWN: UNKNOWN_COLOUR,
    SlipState.NO_CONTACT: UNKNOWN_COLOUR,
    SlipState.STICK: (0.2, 1.0, 0.2, 1.0),
    SlipState.INCIPIENT: (1.0, 0.75, 0.1, 1.0),
    SlipState.FULL: (1.0, 0.1, 0.5, 1.0),
}
HEAD_LENGTH, HEAD_HALF_WIDTH = 0.25, 0.1
# Arrows shorter than this, as drawn, would only be dots.
SHORTEST_ARROW_M = 2e-5
# The arc around the arrow of a moment: its radius and place in lengths of the arrow.
TURN_RADIUS, TURN_PLACE, TURN_SIDES = 0.35, 0.5, 18
TURN_ANGLE = 1.5 * np.pi
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


def _palette() -> NDArray[np.float32]:
    bgr = cv2.applyColorMap(np.arange(256, dtype=np.uint8), cv2.COLORMAP_VIRIDIS)
    rgb = bgr.reshape(-1, 3)[:, ::-1] / 255.0
    return np.hstack([rgb, np.full((256, 1), MESH_ALPHA)]).astype(np.float32)


# (256, 4): from no indentation to that of depth_range.
DEPTH_PALETTE = _palette()


def depth_colours(shares: NDArray[np.float64]) -> NDArray[np.float32]:
    """Colours (..., 4) RGBA, 0 to 1, for shares of the largest depth; those outside are clipped."""
    last = len(DEPTH_PALETTE) - 1
    return DEPTH_PALETTE[np.rint(last * np.clip(shares, 0.0, 1.0)).astype(np.intp)]


def with_deviation(value: float, variance: float) -> str:
    """A value, and its standard deviation with one digit that is not 0 where it is known."""
    deviation = math.sqrt(variance) if variance > 0 else 0.0
    digits = LEAST_DIGITS
    while digits < MOST_DIGITS and float(f"{deviation:.{digits}f}") == 0.0:
        digits += 1
    if float(f"{deviation:.{digits}f}") == 0.0:
        return f"{value:.{LEAST_DIGITS}f}"
    return f"{value:.{digits}f} +/- {deviation:.{digits}f}"


def contact_lines(contact: Contact) -> list[str]:
    """What is written at a contact: normal force and its deviation, area and slip state.

    ASCII: RViz has no other letters.
    """
    force = with_deviation(float(contact.wrench[2]), float(contact.covariance[2, 2]))
    lines = [f"Fz {force} N", f"{contact.area * 1e6:.1f} mm^2"]
    if contact.at_border:
        lines[-1] += ", at the border"
    if contact.slip.state not in (SlipState.UNKNOWN, SlipState.NO_CONTACT):
        lines.append(SLIP_WORDS[contact.slip.state])
    return lines


def grasp_line(state: GraspState) -> str:
    """Grip, margin to slip and weight of a grasp, as far as they are known."""
    parts = [f"grip {state.grip_force:.1f} N"]
    if math.isfinite(state.slip_margin):
        parts.append(f"margin {100 * state.slip_margin:.0f} %")
    if math.isfinite(state.supported_weight):
        parts.append(f"carries {state.supported_weight:.2f} N")
    return ", ".join(parts)


def arrows(
    tails: NDArray[np.float64],
    vectors: NDArray[np.float64],
    shortest: float = SHORTEST_ARROW_M,
) -> NDArray[np.float64]:
    """Ends (3 A, 2, 3) of shaft and two barbs of each arrow that is finite and over `shortest`.

    tails, vectors: (N, 3).
    """
    length = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    drawn = np.isfinite(tails).all(axis=-1) & (length > shortest)
    tails, vectors, length = tails[drawn], vectors[drawn], length[drawn, None]
    side = np.stack([vectors[:, 1], -vectors[:, 0], np.zeros(len(vectors))], axis=-1)
    across = np.hypot(side[:, 0], side[:, 1])
    # An arrow along z has no side in the xy plane; x serves as well.
    flat = across < 1e-6 * length[:, 0]
    side[flat], across[flat] = (1.0, 0.0, 0.0), 1.0
    side *= HEAD_HALF_WIDTH * length / across[:, None]
    tips = tails + vectors
    back = tips - HEAD_LENGTH * vectors
    ends = np.stack([tails, tips, tips, back + side, tips, back - side], axis=1)
    return ends.reshape(-1, 2, 3)


def turning_arrow(centre: NDArray[np.float64], vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ends (S, 2, 3) of an arrow along the axis (3,) of a moment, and an arc in its sense.

    It stands on `centre` (3,), on the side of greater z, and is empty where not finite or tiny.
    """
    tail = centre if vector[2] >= 0 else centre - vector
    shaft = arrows(tail[None], vector[None])
    if not len(shaft):
        return shaft
    length = np.linalg.norm(vector)
    axis = vector / length
    across = np.cross(axis, (0.0, 0.0, 1.0) if abs(axis[2]) < 0.9 else (1.0, 0.0, 0.0))
    across /= np.linalg.norm(across)
    angle = np.linspace(0.0, TURN_ANGLE, TURN_SIDES + 1)[:, None]
    radius = TURN_RADIUS * length
    arc = radius * (np.cos(angle) * across + np.sin(angle) * np.cross(axis, across))
    arc += tail + TURN_PLACE * vector
    sides = np.stack([arc[:-1], arc[1:]], axis=1)
    along = arc[-1] - arc[-2]
    along *= 2 * radius / np.linalg.norm(along)
    barbs = arrows(arc[-1:] - along, along[None])[1:]
    return np.concatenate([shaft, sides, barbs])


def closed(outline: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sides (S, 2, 3) of a closed polygon (S, 3), those with NaN left out."""
    sides = np.stack([outline, np.roll(outline, -1, axis=0)], axis=1)
    return np.asarray(sides[np.isfinite(sides).all(axis=(1, 2))])


def mesh_vertices(known: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Numbers of grid points, three a triangle, that face +z where rows go +y and columns +x.

    known (rows, cols): a cell of the grid has two triangles if all its corners are known.
    """
    number = np.arange(known.size).reshape(known.shape)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    whole = known[:-1, :-1] & known[:-1, 1:] & known[1:, 1:] & known[1:, :-1]
    return np.stack([a, b, c, a, c, d], axis=-1)[whole].ravel()


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
