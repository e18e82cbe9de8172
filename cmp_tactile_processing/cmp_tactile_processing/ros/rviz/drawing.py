"""Draws for RViz: markers as serialised bytes, and gridlines into the image they were found in.

A marker has thousands of points, and rclpy spends a microsecond on each of its message objects:
twice, once to make it and once to serialise it, with the interpreter's lock held.  The bytes of a
visualization_msgs/MarkerArray that a publisher takes instead are written from the arrays at once.
"""

from __future__ import annotations

import struct
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from cmp_tactile_processing.measured import Grid, GridFault, Status
from cmp_tactile_processing.sensor.parameters import Parameters, parameter

NS_PER_S = 1_000_000_000


class DrawingRate:
    """Calls `draw` when asked; of what is asked for too early, once more when the time has come.

    People see no more than some 20 pictures a second, and frames come at 60 Hz.  Nothing runs
    while nothing is asked for.
    """

    def __init__(self, node: Node, draw: Callable[[], None], rate_hz: float) -> None:
        """rate_hz: 0 for no limit."""
        self._draw = draw
        self._waiting = False
        # Steady: a paused simulation clock must not stop it.
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(1.0, self._time_has_come, clock=clock, autostart=False)
        self.limit(rate_hz)

    def limit(self, rate_hz: float) -> None:
        """Change the rate."""
        self._limited = rate_hz > 0
        if self._limited:
            self._timer.timer_period_ns = round(NS_PER_S / rate_hz)

    def request(self) -> None:
        """Draw now or, where that would be too often, soon."""
        if not self._limited:
            self._draw()
        elif self._timer.is_canceled():
            self._timer.reset()
            self._draw()
        else:
            self._waiting = True

    def _time_has_come(self) -> None:
        if self._waiting:
            self._waiting = False
            self._draw()
        else:
            self._timer.cancel()


HEAD_LENGTH, HEAD_HALF_WIDTH = 0.25, 0.1
# Arrows shorter than this, as drawn, would only be dots.
SHORTEST_ARROW_M = 2e-5
# The arc around the arrow of a moment: its radius and place in lengths of the arrow.
TURN_RADIUS, TURN_PLACE, TURN_SIDES = 0.35, 0.5, 18
TURN_ANGLE = 1.5 * np.pi


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


# Plain CDR, little endian: what every middleware of ROS 2 takes.
ENCAPSULATION = b"\x00\x01\x00\x00"
RGBA = tuple[float, float, float, float]


@dataclass(frozen=True)
class DrawnMarker:
    """One marker: lists of points, or a text at `position`.  One that shows nothing is deleted.

    namespace and number are its name.  kind: Marker.LINE_LIST, ...  points (P, 3) m, and where
    each has a colour of its own, colours (P, 4).  scale (x, y, z) as the kind takes it.
    """

    namespace: str
    kind: int
    number: int = 0
    points: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    colours: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 4), np.float32))
    colour: RGBA = (1.0, 1.0, 1.0, 1.0)
    scale: tuple[float, float, float] = (0.0, 0.0, 0.0)
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    text: str = ""

    @property
    def action(self) -> int:
        """RViz reports a list without points as an error, and keeps what is sent no more."""
        if self.kind == Marker.TEXT_VIEW_FACING:
            shown = bool(self.text) and bool(np.isfinite(self.position).all())
        else:
            shown = len(self.points) > 0
        return int(Marker.ADD if shown else Marker.DELETE)


def marker_array_bytes(markers: Sequence[DrawnMarker], header: Header, lifetime_s: float) -> bytes:
    """The serialised MarkerArray; a marker that is not renewed vanishes after its lifetime, if > 0.

    The markers move with their frame: they are true of the gel wherever the finger is by now.
    """
    stream = _Stream()
    stream.pack("I", len(markers))
    for marker in markers:
        _write_marker(stream, marker, header, lifetime_s)
    return stream.content()


def delete_all(header: Header) -> bytes:
    """The serialised MarkerArray that deletes all markers of its topic."""
    stream = _Stream()
    stream.pack("I", 1)
    _write_start(stream, DrawnMarker("", 0), header, Marker.DELETEALL)
    _write_rest(stream, DrawnMarker("", 0), 0.0)
    return stream.content()


def _write_marker(stream: _Stream, marker: DrawnMarker, header: Header, lifetime_s: float) -> None:
    action = marker.action
    _write_start(stream, marker, header, action)
    gone = DrawnMarker(marker.namespace, marker.kind, marker.number)
    _write_rest(stream, marker if action == Marker.ADD else gone, lifetime_s)


def _write_start(stream: _Stream, marker: DrawnMarker, header: Header, action: int) -> None:
    """The fields of Marker.msg in their order: header, ns, id, type, action."""
    stream.pack_aligned("iI", header.stamp.sec, header.stamp.nanosec)
    stream.string(header.frame_id)
    stream.string(marker.namespace)
    stream.pack_aligned("iii", marker.number, marker.kind, action)


def _write_rest(stream: _Stream, marker: DrawnMarker, lifetime_s: float) -> None:
    """From pose on; textures and meshes are empty."""
    stream.align(8)
    stream.pack("3d4d3d", *marker.position, 0.0, 0.0, 0.0, 1.0, *marker.scale)
    stream.pack("4f", *marker.colour)
    stream.pack("iI", *divmod(round(lifetime_s * NS_PER_S), NS_PER_S))
    stream.pack("?", True)
    stream.sequence(marker.points, "<f8")
    stream.sequence(marker.colours, "<f4")
    stream.string("")
    # texture: stamp, frame_id, format, data; uv_coordinates.
    stream.pack_aligned("iI", 0, 0)
    stream.string("")
    stream.string("")
    stream.pack_aligned("II", 0, 0)
    stream.string(marker.text)
    # mesh_resource; mesh_file: filename, data; mesh_use_embedded_materials.
    stream.string("")
    stream.string("")
    stream.pack_aligned("I", 0)
    stream.pack("?", False)


class _Stream:
    """CDR: every number begins at a multiple of its size."""

    def __init__(self) -> None:
        self._parts: list[bytes] = [ENCAPSULATION]
        self._size = 0

    def content(self) -> bytes:
        return b"".join(self._parts)

    def _add(self, part: bytes) -> None:
        self._parts.append(part)
        self._size += len(part)

    def align(self, size: int) -> None:
        missing = -self._size % size
        if missing:
            self._add(bytes(missing))

    def pack(self, form: str, *values: float) -> None:
        self._add(struct.pack("<" + form, *values))

    def pack_aligned(self, form: str, *values: int) -> None:
        self.align(4)
        self.pack(form, *values)

    def string(self, text: str) -> None:
        data = text.encode() + b"\0"
        self.pack_aligned("I", len(data))
        self._add(data)

    def sequence(self, rows: NDArray[Any], form: str) -> None:
        """A sequence of structures, each of the numbers of one row."""
        self.pack_aligned("I", len(rows))
        if len(rows):
            self.align(np.dtype(form).itemsize)
            self._add(np.ascontiguousarray(rows, form).tobytes())


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


@dataclass(frozen=True)
class OverlayParameters(Parameters, section="overlay"):
    """How often the overlay is drawn."""

    overlay_rate: float = parameter(
        15.0,
        "grid_overlay is drawn so often at most; 0: for every image",
        unit="Hz",
        within=(0.0, 1000.0),
    )


def draw_grid(image: NDArray[np.uint8], grid: Grid) -> NDArray[np.uint8]:
    """The view, grey (H, W) or BGR (H, W, 3), as BGR with all that the grid holds.

    Corners that were measured are green dots, those that were predicted orange; a red cross shows
    where a corner next to them is missing; corner (0, 0) has a ring.  Lines through the virtual
    markers are pale and end where a point is missing; the markers on them are dots.  Beneath stand
    the number of corners, confidence, fault and reason.
    """
    image = image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    canvas = image.copy()
    rows = _chains(grid.corners, grid.row_lines)
    cols = _chains(grid.corners.swapaxes(0, 1), grid.col_lines.swapaxes(0, 1))
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


def _chains(corners: NDArray[np.float64], between: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points along each line in order, (lines, points, 2): a corner, its virtual markers, ..."""
    lines, last = corners.shape[0], corners[:, -1:]
    segments = np.concatenate([corners[:, :-1, None], between], axis=2)
    return np.concatenate([segments.reshape(lines, -1, 2), last], axis=1)


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
