"""Draws for RViz: markers as serialised bytes, pages of text, and how often to draw.

A marker has thousands of points, and rclpy spends a microsecond on each of its message objects:
twice, once to make it and once to serialise it, with the interpreter's lock held.  The bytes of a
visualization_msgs/MarkerArray that a publisher takes instead are written from the arrays at once.
NaN never gets into one.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from cmp_tactile_processing.measured import NS_PER_S
from cmp_tactile_processing.sensor.parameters import Parameters, parameter

# Plain CDR, little endian: what every middleware of ROS 2 takes.
ENCAPSULATION = b"\x00\x01\x00\x00"
RGBA = tuple[float, float, float, float]
# From a line of a text to the next, in letters.  Each line is a marker: within one, RViz adds 5 mm
# to each line, whatever the size.
LINE_STEP = 1.2
# Width of a letter in its height: what texts need that stand beside one another.
LETTER_WIDTH = 0.6
# More between texts of a gel that is seen from its edge: the nearer one is drawn larger, letters.
EDGE_GAP = 3.0
# Of up, the part in the gel's plane below which the gel lies flat.
LEAST_SLOPE = 0.05
FLAT = np.array([0.0, 1.0, 0.0])
OUTWARDS = np.array([0.0, 0.0, 1.0])


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


@dataclass(frozen=True)
class OverlayParameters(Parameters, section="overlay"):
    """How often the overlay is drawn."""

    overlay_rate: float = parameter(
        15.0,
        "highest rate of grid_overlay; 0: for every image",
        unit="Hz",
        within=(0.0, 1000.0),
    )


@dataclass(frozen=True)
class DrawnMarker:
    """One marker: lists of points, or a text at `position`.

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
    def shows(self) -> bool:
        """Whether there is anything of it: RViz reports a list without points as an error."""
        if self.kind == Marker.TEXT_VIEW_FACING:
            return bool(self.text) and bool(np.isfinite(self.position).all())
        return len(self.points) > 0


def marker_array_bytes(
    markers: Sequence[DrawnMarker], header: Header, lifetime_s: float = 0.0
) -> bytes:
    """The serialised MarkerArray that puts what the markers show in the place of all earlier ones.

    A marker that is not renewed vanishes after its lifetime, if > 0.  They move with their frame:
    they are true of the gel wherever the finger is by now.
    """
    shown = [marker for marker in markers if marker.shows]
    stream = _Stream()
    stream.numbers("I", 1 + len(shown))
    _write(stream, DrawnMarker("", 0), Marker.DELETEALL, header, 0.0)
    for marker in shown:
        _write(stream, marker, Marker.ADD, header, lifetime_s)
    return stream.content()


def _write(
    stream: _Stream, marker: DrawnMarker, action: int, header: Header, lifetime_s: float
) -> None:
    """The fields of Marker.msg in their order; textures and meshes are empty."""
    stream.numbers("iI", header.stamp.sec, header.stamp.nanosec)
    stream.strings(header.frame_id, marker.namespace)
    stream.numbers("iii", marker.number, marker.kind, action)
    stream.numbers("3d4d3d", *marker.position, 0.0, 0.0, 0.0, 1.0, *marker.scale)
    stream.numbers("4f", *marker.colour)
    stream.numbers("iI", *divmod(round(lifetime_s * NS_PER_S), NS_PER_S))
    stream.numbers("?", True)  # frame_locked
    stream.rows(marker.points, "<f8")
    stream.rows(marker.colours, "<f4")
    # texture_resource; texture: stamp, frame_id, format, data; uv_coordinates.
    stream.strings("")
    stream.numbers("iI", 0, 0)
    stream.strings("", "")
    stream.numbers("II", 0, 0)
    # text; mesh_resource; mesh_file: filename, data; mesh_use_embedded_materials.
    stream.strings(marker.text, "", "")
    stream.numbers("I", 0)
    stream.numbers("?", False)


class _Stream:
    """CDR: every number begins at a multiple of its size."""

    def __init__(self) -> None:
        self._content = bytearray()

    def content(self) -> bytes:
        return ENCAPSULATION + self._content

    def numbers(self, form: str, *values: float) -> None:
        """Numbers of one size, as `struct` names them."""
        self._add(struct.pack(f"<{form}", *values), struct.calcsize(form[-1]))

    def strings(self, *texts: str) -> None:
        for text in texts:
            data = text.encode() + b"\0"
            self.numbers("I", len(data))
            self._add(data, 1)

    def rows(self, rows: NDArray[Any], form: str) -> None:
        """A sequence of structures, each of the numbers of one row."""
        self.numbers("I", len(rows))
        if len(rows):
            self._add(np.ascontiguousarray(rows, form).tobytes(), np.dtype(form).itemsize)

    def _add(self, data: bytes, size: int) -> None:
        self._content += bytes(-len(self._content) % size) + data


@dataclass(frozen=True)
class Page:
    """The gel as a page that the viewer has before him; unit vectors (3,) of the gel frame.

    up: what is up for the viewer.  slope: the same in the gel's plane; y of a gel that lies flat,
    which has it up for who looks down on it.  right, top: the page's edges, along the gel's.
    """

    up: NDArray[np.float64]
    slope: NDArray[np.float64]
    right: NDArray[np.float64]
    top: NDArray[np.float64]

    @classmethod
    def of(cls, up: Sequence[float]) -> Page:
        """The page for an up of any length; that of the gel frame's z where it has none."""
        length = float(np.linalg.norm(up))
        unit = np.asarray(up, np.float64) / length if length > 0 else OUTWARDS
        flat = np.append(unit[:2], 0.0)
        steepness = float(np.linalg.norm(flat))
        slope = flat / steepness if steepness > LEAST_SLOPE else FLAT
        axis = int(np.argmax(np.abs(slope)))
        top = np.zeros(3)
        top[axis] = np.sign(slope[axis])
        return cls(unit, slope, np.cross(top, OUTWARDS), top)

    @property
    def stack(self) -> NDArray[np.float64]:
        """The way up from line to line: apart from above as well as from the side."""
        outwards: NDArray[np.float64] = self.up[2] * OUTWARDS
        return self.slope + outwards

    def height(self, points: NDArray[np.float64]) -> float:
        """How far up the slope points (..., 3) reach; -inf where none is known."""
        heights = points.reshape(-1, 3) @ self.slope
        known = heights[np.isfinite(heights)]
        return float(known.max()) if len(known) else -np.inf

    def extent(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The least and the greatest (right, top) of points (N, 3)."""
        across = points @ np.stack([self.right, self.top], axis=1)
        return across.min(axis=0), across.max(axis=0)

    def place(
        self, right: NDArray[np.float64] | float, top: NDArray[np.float64] | float, z: float
    ) -> NDArray[np.float64]:
        """The points (..., 3) at these places of the page."""
        flat = np.multiply.outer(right, self.right) + np.multiply.outer(top, self.top)
        return flat + z * OUTWARDS


def stacked(  # noqa: PLR0913, PLR0917 - what is written, where, how large
    namespace: str,
    first: int,
    place: NDArray[np.float64],
    lines: Sequence[tuple[str, RGBA]],
    size: float,
    page: Page,
) -> list[DrawnMarker]:
    """A marker for each line and its colour around a place (3,), numbered on from the top one.

    RViz takes half of scale.x for the width of a space, and some 0.7 m where that is 0.
    """
    below = LINE_STEP * size * (np.arange(len(lines)) - (len(lines) - 1) / 2)
    places = (place - below[:, None] * page.stack).tolist()
    return [
        DrawnMarker(
            namespace,
            Marker.TEXT_VIEW_FACING,
            first + number,
            colour=colour,
            scale=(size, 0.0, size),
            position=(x, y, z),
            text=line,
        )
        for number, ((line, colour), (x, y, z)) in enumerate(zip(lines, places, strict=True))
    ]


def clear_places(
    places: Sequence[NDArray[np.float64]],
    texts: Sequence[Sequence[str]],
    size: float,
    page: Page,
) -> list[NDArray[np.float64]]:
    """Where the middles of texts may stand so that none covers another; places (3,) are wished.

    The lowest stays where it is; one that is higher gives way upwards.  On a gel that stands
    upright, which may be seen from its edge, texts never stand beside one another.
    """
    is_upright = abs(page.up[2]) < LEAST_SLOPE
    found = [place.copy() for place in places]
    ways = [(page.slope, 1.0), (OUTWARDS * (np.sign(page.up[2]) or 1.0), abs(page.up[2]))]
    done: list[int] = []
    for number in sorted(range(len(found)), key=lambda k: float(places[k] @ page.slope)):
        for other in done:
            both = [texts[number], texts[other]]
            width = LETTER_WIDTH * size * sum(max(map(len, lines)) for lines in both) / 2
            if not is_upright and abs((found[number] - found[other]) @ page.right) >= width:
                continue
            gap = LINE_STEP * size * (sum(map(len, both)) + 1) / 2 + is_upright * EDGE_GAP * size
            for way, share in ways:
                missing = share * gap - (found[number] - found[other]) @ way
                found[number] += max(0.0, missing) * way
        done.append(number)
    return found
