"""Draws for RViz: markers of the surface and of the force on it, as serialised bytes.

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

from cmp_tactile_processing.drawing import (
    DISPLACEMENT_COLOUR,
    FORCE_COLOUR,
    LEGEND_COLOUR,
    SLIP_COLOURS,
    UNKNOWN_COLOUR,
    arrows,
    closed,
    contact_lines,
    depth_colours,
    mesh_vertices,
    turning_arrow,
)
from cmp_tactile_processing.measured import Contact, ForceField, Surface
from cmp_tactile_processing.sensor.parameters import Parameters, parameter

NS_PER_S = 1_000_000_000

# Plain CDR, little endian: what every middleware of ROS 2 takes.
ENCAPSULATION = b"\x00\x01\x00\x00"
RGBA = tuple[float, float, float, float]
# From a line of a text to the next, in letters.  Each line is a marker: within one, RViz adds 5 mm
# to each line, whatever the size.
LINE_STEP = 1.2
# Width of a letter in its height: what texts need that stand beside one another.
LETTER_WIDTH = 0.6
# Of up, the part in the gel's plane below which the gel lies flat.
LEAST_SLOPE = 0.05
FLAT = np.array([0.0, 1.0, 0.0])
OUTWARDS = np.array([0.0, 0.0, 1.0])
# Arrows of nodes that are shorter than this, in widths of their line, would only be dots.
SHORTEST_ARROW = 2.0
# Contacts that have a text, and the lines of each.
MOST_TEXTS, MOST_LINES = 8, 3
# From gel and arrows up to the middle of a contact's text, in letters.
TEXT_HEIGHT = 4.0
# The colour bar beside the gel: steps, and gap and width in letters.
BAR_STEPS, BAR_GAP, BAR_WIDTH = 32, 2.0, 1.5
# From the gel down to the middle of what is written of the arrows, in letters.
SCALES_BELOW = 6.0


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

    The lowest stays where it is; one that is higher gives way upwards.
    """
    found = [place.copy() for place in places]
    ways = [(page.slope, 1.0), (OUTWARDS * (np.sign(page.up[2]) or 1.0), abs(page.up[2]))]
    done: list[int] = []
    for number in sorted(range(len(found)), key=lambda k: float(places[k] @ page.slope)):
        for other in done:
            both = [texts[number], texts[other]]
            width = LETTER_WIDTH * size * sum(max(map(len, lines)) for lines in both) / 2
            if abs((found[number] - found[other]) @ page.right) >= width:
                continue
            gap = LINE_STEP * size * (sum(map(len, both)) + 1) / 2
            for way, share in ways:
                missing = share * gap - (found[number] - found[other]) @ way
                found[number] += max(0.0, missing) * way
        done.append(number)
    return found


@dataclass(frozen=True)
class MarkerParameters(Parameters, section="markers"):
    """How the markers are drawn."""

    displacement_gain: float = parameter(
        1.0, "length of a displacement arrow per displacement; 0: no arrows", within=(0.0, 1e3)
    )
    force_gain: float = parameter(
        0.05,
        "length of a force arrow per force on a node; 0: no arrows",
        unit="m/N",
        within=(0.0, 1e3),
    )
    depth_range: float = parameter(
        0.001, "indentation at the end of the mesh's colour scale", unit="m", within=(1e-6, 1.0)
    )
    resultant_gain: float = parameter(
        0.001,
        "length of a contact's force arrow per force; 0: no arrow",
        unit="m/N",
        within=(0.0, 1e3),
    )
    moment_gain: float = parameter(
        0.5,
        "length of a contact's moment arrow per moment; 0: no arrow",
        unit="m/(N m)",
        within=(0.0, 1e5),
    )
    contact_text: bool = parameter(True, "write normal force, area and slip state at each contact")
    legend: bool = parameter(
        True, "draw a bar with the colours of depth, and the scales of the arrows"
    )
    up: tuple[float, float, float] = parameter(
        (0.0, 0.0, 1.0),
        "the viewer's up direction in the gel frame, for lines of text and the colour bar",
        within=(-1.0, 1.0),
    )
    text_size: float = parameter(0.0006, "height of the letters", unit="m", within=(1e-6, 1.0))
    line_width: float = parameter(
        0.00005,
        "width of arrows; outlines are 2 times and resultants and moments 3 times as wide",
        unit="m",
        within=(1e-6, 1.0),
    )
    max_rate: float = parameter(
        15.0,
        "highest rate of markers; 0: with every message",
        unit="Hz",
        within=(0.0, 1000.0),
    )
    lifetime: float = parameter(
        2.0,
        "time after which markers vanish if they are not drawn again; 0: never",
        unit="s",
        within=(0.0, 3600.0),
    )


def surface_markers(surface: Surface, look: MarkerParameters) -> list[DrawnMarker]:
    """The mesh coloured by indentation, the displacement arrows from the reference, the legend."""
    lines = np.empty((0, 2, 3))
    if look.displacement_gain:
        drawn = look.displacement_gain * surface.displacement.reshape(-1, 3)
        shortest = SHORTEST_ARROW * look.line_width
        lines = arrows(surface.reference.reshape(-1, 3), drawn, shortest)
    return [
        _mesh(surface, look.depth_range),
        _lines("displacement", lines, DISPLACEMENT_COLOUR, look.line_width),
        *_legend(surface, look),
    ]


def force_markers(field: ForceField, look: MarkerParameters) -> list[DrawnMarker]:
    """Arrows of the force on the nodes in contact, and what `_contact_markers` draws of each.

    A press comes from outside of the gel: an arrow that began at the node would be hidden in it.
    """
    drawn = look.force_gain * field.force[field.contact]
    shortest = SHORTEST_ARROW * look.line_width
    lines = arrows(field.position[field.contact] - drawn, drawn, shortest)
    return [
        _lines("force", lines, FORCE_COLOUR, look.line_width),
        *_contact_markers(field, look, lines),
    ]


def _contact_markers(
    field: ForceField, look: MarkerParameters, arrows: NDArray[np.float64]
) -> list[DrawnMarker]:
    """Outline, resultant, moment and text of each contact, in the colour of its slip state."""
    shown = [(item, SLIP_COLOURS[item.slip.state]) for item in field.contacts]
    outlines = [(closed(item.outline), colour) for item, colour in shown]
    resultants = [(_resultant(item, look.resultant_gain), colour) for item, colour in shown]
    moments = [
        (_moment(item, field.reference_point, look.moment_gain), colour) for item, colour in shown
    ]
    markers = [
        _coloured_lines("contact", outlines, 2 * look.line_width),
        _coloured_lines("resultant", resultants, 3 * look.line_width),
        _coloured_lines("moment", moments, 3 * look.line_width),
    ]
    if look.contact_text:
        drawn = [part for part, _ in (*resultants, *moments)]
        markers += _contact_texts(field, look, [field.position, arrows, *drawn])
    return markers


def _contact_texts(
    field: ForceField, look: MarkerParameters, drawn: Sequence[NDArray[np.float64]]
) -> list[DrawnMarker]:
    """What is written of the strongest contacts, each over its own, beyond all that is drawn.

    So it covers neither the gel nor its neighbours, and is seen from behind the gel as well.
    """
    page, size = Page.of(look.up), look.text_size
    contacts = field.contacts[:MOST_TEXTS]
    edge = max(page.height(points) for points in drawn)
    lines = [contact_lines(item) for item in contacts]
    places = []
    for item in contacts:
        centre = item.centre_of_pressure
        beyond = max(edge - float(centre @ page.slope), 0.0) * page.slope
        places.append(centre + beyond + TEXT_HEIGHT * size * page.stack)
    markers: list[DrawnMarker] = []
    free = clear_places(places, lines, size, page)
    for number, (item, place, own) in enumerate(zip(contacts, free, lines, strict=True)):
        coloured = [(line, SLIP_COLOURS[item.slip.state]) for line in own]
        first = MOST_LINES * number
        markers += stacked("contact_text", first, place, coloured, size, page)
    return markers


def _resultant(contact: Contact, gain: float) -> NDArray[np.float64]:
    """The arrow of a contact's force, which ends at its centre of pressure."""
    drawn = gain * contact.wrench[None, :3]
    return arrows(contact.centre_of_pressure - drawn, drawn)


def _moment(
    contact: Contact, moment_point: NDArray[np.float64], gain: float
) -> NDArray[np.float64]:
    """The arrow and arc of a contact's moment about its own centre of pressure.

    What is left there of the moment about the gel frame's origin is torsion, mostly.
    """
    centre = contact.centre_of_pressure
    force, moment = contact.wrench[:3], contact.wrench[3:]
    return turning_arrow(centre, gain * (moment - np.cross(centre - moment_point, force)))


def _mesh(surface: Surface, depth_range: float) -> DrawnMarker:
    """Two triangles for each cell of which all four corners are known."""
    depth = -surface.displacement[..., 2]
    known = np.isfinite(surface.position).all(axis=-1) & np.isfinite(depth)
    vertices = mesh_vertices(known)
    colours = depth_colours(depth.ravel()[vertices] / depth_range)
    points = surface.position.reshape(-1, 3)[vertices]
    return _triangles("surface", points, colours)


def _triangles(
    namespace: str, points: NDArray[np.float64], colours: NDArray[np.float32]
) -> DrawnMarker:
    kind, scale = Marker.TRIANGLE_LIST, (1.0, 1.0, 1.0)
    return DrawnMarker(namespace, kind, points=points, colours=colours, scale=scale)


def _legend(surface: Surface, look: MarkerParameters) -> list[DrawnMarker]:
    """Bar of the colours of depth, right of the gel, its ends, and the scales of the arrows."""
    known = surface.reference[np.isfinite(surface.reference).all(axis=-1)]
    if not (look.legend and len(known)):
        return []
    page, size = Page.of(look.up), look.text_size
    (far_left, low), (right, high) = page.extent(known)
    left, z = right + BAR_GAP * size, float(np.median(known[:, 2]))
    x, y = np.meshgrid([left, left + BAR_WIDTH * size], np.linspace(low, high, BAR_STEPS + 1))
    grid = page.place(x, y, z).reshape(-1, 3)
    vertices = mesh_vertices(np.ones(x.shape, bool))
    bar = _triangles("legend", grid[vertices], depth_colours((vertices // 2) / BAR_STEPS))
    middle = left + BAR_WIDTH * size / 2
    ends = (("0", low - size), (f"{look.depth_range * 1e3:g} mm deep", high + size))
    markers = [bar]
    for word, top in ends:
        place, line = page.place(middle, top, z), [(word, LEGEND_COLOUR)]
        markers += stacked("legend", len(markers), place, line, size, page)
    below = page.place((far_left + right) / 2, low - SCALES_BELOW * size, z)
    return markers + stacked("legend", len(markers), below, _scales(look), size, page)


def _scales(look: MarkerParameters) -> list[tuple[str, RGBA]]:
    """What each kind of arrow is and how long it is drawn, with the colour to write it in."""
    return [
        (f"white: displacement x {look.displacement_gain:g}", DISPLACEMENT_COLOUR),
        (f"red: force at a node, 0.1 N = {look.force_gain * 100:g} mm", FORCE_COLOUR),
        (f"thick: force of a contact, 1 N = {look.resultant_gain * 1e3:g} mm", LEGEND_COLOUR),
        (f"with an arc: its moment, 10 N mm = {look.moment_gain * 10:g} mm", LEGEND_COLOUR),
    ]


def _lines(
    namespace: str, segments: NDArray[np.float64], colour: RGBA, width: float
) -> DrawnMarker:
    points = segments.reshape(-1, 3)
    scale = (width, 0.0, 0.0)
    return DrawnMarker(namespace, Marker.LINE_LIST, points=points, colour=colour, scale=scale)


def _coloured_lines(
    namespace: str, parts: Sequence[tuple[NDArray[np.float64], RGBA]], width: float
) -> DrawnMarker:
    """Segments (S, 2, 3) in a colour of their own, all in one marker."""
    segments = np.concatenate([np.empty((0, 2, 3)), *(part for part, _ in parts)])
    counts = [2 * len(part) for part, _ in parts]
    colours = np.array([colour for _, colour in parts], np.float32).reshape(-1, 4)
    return DrawnMarker(
        namespace,
        Marker.LINE_LIST,
        points=segments.reshape(-1, 3),
        colours=np.repeat(colours, counts, axis=0),
        colour=UNKNOWN_COLOUR,
        scale=(width, 0.0, 0.0),
    )
