"""RViz markers of the surface and of the force on it; NaN never gets into one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from visualization_msgs.msg import Marker

from cmp_tactile_processing.drawing import shapes
from cmp_tactile_processing.drawing.looks import (
    DISPLACEMENT_COLOUR,
    FORCE_COLOUR,
    LEGEND_COLOUR,
    SLIP_COLOURS,
    UNKNOWN_COLOUR,
    contact_lines,
    depth_colours,
)
from cmp_tactile_processing.measured import Contact, ForceField, Surface
from cmp_tactile_processing.ros.rviz import drawing
from cmp_tactile_processing.sensor.parameters import Parameters, parameter


@dataclass(frozen=True)
class MarkerParameters(Parameters, section="markers"):
    """How the markers are drawn."""

    displacement_gain: float = parameter(
        1.0, "drawn length of a displacement arrow per displacement; 0: none", within=(0.0, 1e3)
    )
    force_gain: float = parameter(
        0.05,
        "drawn length of a force arrow per force on a node; 0: none",
        unit="m/N",
        within=(0.0, 1e3),
    )
    depth_range: float = parameter(
        0.001, "indentation at which the colour of the mesh ends", unit="m", within=(1e-6, 1.0)
    )
    resultant_gain: float = parameter(
        0.001,
        "drawn length of the arrow of a contact's force per force; 0: none",
        unit="m/N",
        within=(0.0, 1e3),
    )
    moment_gain: float = parameter(
        0.5,
        "drawn length of the arrow of a contact's moment per moment; 0: none",
        unit="m/(N m)",
        within=(0.0, 1e5),
    )
    contact_text: bool = parameter(
        True, "whether normal force, area and slip state are written at each contact"
    )
    legend: bool = parameter(
        True, "whether a bar with the colours of depth and the scales of the arrows is drawn"
    )
    text_size: float = parameter(0.0006, "height of the letters", unit="m", within=(1e-6, 1.0))
    line_width: float = parameter(
        0.00005,
        "width of arrows, half that of outlines, a third of that of resultants and moments",
        unit="m",
        within=(1e-6, 1.0),
    )
    max_rate: float = parameter(
        15.0,
        "markers are drawn so often at most; 0: with every message",
        unit="Hz",
        within=(0.0, 1000.0),
    )
    lifetime: float = parameter(
        2.0,
        "time after which markers vanish that are not drawn again; 0: never",
        unit="s",
        within=(0.0, 3600.0),
    )


# Arrows of nodes that are shorter than this, in widths of their line, would only be dots.
SHORTEST_ARROW = 2.0
# So many texts are written or deleted each time: those of before need not be remembered.
MOST_TEXTS, MOST_LINES, LEGEND_TEXTS = 8, 3, 6
# Height of a text's middle over contact and arrows, in letters: it is of three lines.
TEXT_HEIGHT = 3.0
# From a line of a text to the next, in letters.  Each line is a marker: within one, RViz adds 5 mm
# to each line, whatever the size.  Along y as well, so that a look along z shows them apart too.
LINE_STEP = np.array([0.0, -1.2, -1.2])
# The colour bar beside the gel: steps, and gap and width in letters.
BAR_STEPS, BAR_GAP, BAR_WIDTH = 32, 2.0, 1.5


def surface_markers(surface: Surface, look: MarkerParameters) -> list[drawing.DrawnMarker]:
    """The mesh coloured by indentation, the displacement arrows from the reference, the legend."""
    lines = np.empty((0, 2, 3))
    if look.displacement_gain:
        drawn = look.displacement_gain * surface.displacement.reshape(-1, 3)
        shortest = SHORTEST_ARROW * look.line_width
        lines = shapes.arrows(surface.reference.reshape(-1, 3), drawn, shortest)
    return [
        _mesh(surface, look.depth_range),
        _lines("displacement", lines, DISPLACEMENT_COLOUR, look.line_width),
        *_legend(surface, look),
    ]


def force_markers(field: ForceField, look: MarkerParameters) -> list[drawing.DrawnMarker]:
    """Arrows of the force on the nodes in contact, and what `_contact_markers` draws of each.

    A press comes from outside of the gel: an arrow that began at the node would be hidden in it.
    """
    drawn = look.force_gain * field.force[field.contact]
    shortest = SHORTEST_ARROW * look.line_width
    lines = shapes.arrows(field.position[field.contact] - drawn, drawn, shortest)
    return [
        _lines("force", lines, FORCE_COLOUR, look.line_width),
        *_contact_markers(field.contacts, field.reference_point, look, _highest(lines)),
    ]


def _contact_markers(
    contacts: Sequence[Contact],
    moment_point: NDArray[np.float64],
    look: MarkerParameters,
    above: float,
) -> list[drawing.DrawnMarker]:
    """Outline, resultant, moment and text of each contact, in the colour of its slip state.

    Texts stand above z = `above` and above what is drawn of the contact.
    """
    shown = [(item, SLIP_COLOURS[item.slip.state]) for item in contacts]
    outlines = [(shapes.closed(item.outline), colour) for item, colour in shown]
    resultants = [(_resultant(item, look.resultant_gain), colour) for item, colour in shown]
    moments = [(_moment(item, moment_point, look.moment_gain), colour) for item, colour in shown]
    markers = [
        _coloured_lines("contact", outlines, 2 * look.line_width),
        _coloured_lines("resultant", resultants, 3 * look.line_width),
        _coloured_lines("moment", moments, 3 * look.line_width),
    ]
    texts = shown[:MOST_TEXTS] if look.contact_text else []
    for number, (item, colour) in enumerate(texts):
        arrow_tops = _highest(resultants[number][0]), _highest(moments[number][0])
        bottom = max(above, *arrow_tops, item.centre_of_pressure[2])
        place = *item.centre_of_pressure[:2], bottom + TEXT_HEIGHT * look.text_size
        middle = _text("contact_text", MOST_LINES * number, place, look.text_size)
        markers += _lines_of_text(replace(middle, colour=colour), contact_lines(item))
    return markers + _unused(markers, "contact_text", range(MOST_LINES * MOST_TEXTS))


def _text(
    namespace: str, number: int, place: tuple[float, float, float], size: float
) -> drawing.DrawnMarker:
    """RViz takes half of scale.x for the width of a space, and some 0.7 m where that is 0."""
    scale, kind = (size, 0.0, size), Marker.TEXT_VIEW_FACING
    return drawing.DrawnMarker(namespace, kind, number, scale=scale, position=place)


def _lines_of_text(middle: drawing.DrawnMarker, lines: Sequence[str]) -> list[drawing.DrawnMarker]:
    """A marker for each line, numbered on from the one in the middle of them."""
    from_middle = np.arange(len(lines)) - (len(lines) - 1) / 2
    steps = middle.scale[2] * from_middle[:, None] * LINE_STEP
    return [
        replace(middle, number=number, position=(x, y, z), text=line)
        for number, (line, (x, y, z)) in enumerate(
            zip(lines, (np.array(middle.position) + steps).tolist(), strict=True), middle.number
        )
    ]


def _unused(
    markers: Sequence[drawing.DrawnMarker], namespace: str, numbers: Iterable[int]
) -> list[drawing.DrawnMarker]:
    """Texts without letters, which deletes them, for the numbers that none of the markers has."""
    used = {marker.number for marker in markers if marker.namespace == namespace}
    free = [number for number in numbers if number not in used]
    return [drawing.DrawnMarker(namespace, Marker.TEXT_VIEW_FACING, number) for number in free]


def _highest(segments: NDArray[np.float64]) -> float:
    return float(segments[..., 2].max()) if len(segments) else -np.inf


def _resultant(contact: Contact, gain: float) -> NDArray[np.float64]:
    """The arrow of a contact's force, which ends at its centre of pressure."""
    drawn = gain * contact.wrench[None, :3]
    return shapes.arrows(contact.centre_of_pressure - drawn, drawn)


def _moment(
    contact: Contact, moment_point: NDArray[np.float64], gain: float
) -> NDArray[np.float64]:
    """The arrow and arc of a contact's moment about its own centre of pressure.

    What is left there of the moment about the gel frame's origin is torsion, mostly.
    """
    centre = contact.centre_of_pressure
    force, moment = contact.wrench[:3], contact.wrench[3:]
    return shapes.turning_arrow(centre, gain * (moment - np.cross(centre - moment_point, force)))


def _mesh(surface: Surface, depth_range: float) -> drawing.DrawnMarker:
    """Two triangles for each cell of which all four corners are known."""
    depth = -surface.displacement[..., 2]
    known = np.isfinite(surface.position).all(axis=-1) & np.isfinite(depth)
    vertices = shapes.mesh_vertices(known)
    colours = depth_colours(depth.ravel()[vertices] / depth_range)
    points = surface.position.reshape(-1, 3)[vertices]
    return drawing.DrawnMarker(
        "surface", Marker.TRIANGLE_LIST, points=points, colours=colours, scale=(1.0, 1.0, 1.0)
    )


def _legend(surface: Surface, look: MarkerParameters) -> list[drawing.DrawnMarker]:
    """Bar of the colours of depth, right of the gel, its ends, and the scales of the arrows."""
    known = surface.reference[np.isfinite(surface.reference).all(axis=-1)]
    numbers = range(1, LEGEND_TEXTS + 1)
    if not (look.legend and len(known)):
        return [
            drawing.DrawnMarker("legend", Marker.TRIANGLE_LIST),
            *_unused([], "legend", numbers),
        ]
    size = look.text_size
    (far_left, low, _), (right, high, _) = known.min(axis=0), known.max(axis=0)
    left, z = right + BAR_GAP * size, float(np.median(known[:, 2]))
    x, y = np.meshgrid([left, left + BAR_WIDTH * size], np.linspace(low, high, BAR_STEPS + 1))
    grid = np.stack([x, y, np.full_like(x, z)], axis=-1).reshape(-1, 3)
    vertices = shapes.mesh_vertices(np.ones(x.shape, bool))
    bar = drawing.DrawnMarker(
        "legend",
        Marker.TRIANGLE_LIST,
        points=grid[vertices],
        colours=depth_colours((vertices // 2) / BAR_STEPS),
        scale=(1.0, 1.0, 1.0),
    )
    middle = left + BAR_WIDTH * size / 2
    written = (
        (["0"], (middle, low - size, z)),
        ([f"{look.depth_range * 1e3:g} mm deep"], (middle, high + size, z)),
        (_scales(look), ((far_left + right) / 2, low - 7.0 * size, z)),
    )
    markers = [bar]
    for lines, place in written:
        middle_line = _text("legend", len(markers), place, size)
        markers += _lines_of_text(replace(middle_line, colour=LEGEND_COLOUR), lines)
    return markers


def _scales(look: MarkerParameters) -> list[str]:
    """How long the arrows are."""
    return [
        f"displacement x {look.displacement_gain:g}",
        f"at a node 0.1 N = {look.force_gain * 100:g} mm",
        f"contact: 1 N = {look.resultant_gain * 1e3:g} mm",
        f"10 N mm = {look.moment_gain * 10:g} mm",
    ]


def _lines(
    namespace: str, segments: NDArray[np.float64], colour: drawing.RGBA, width: float
) -> drawing.DrawnMarker:
    points = segments.reshape(-1, 3)
    scale = (width, 0.0, 0.0)
    return drawing.DrawnMarker(
        namespace, Marker.LINE_LIST, points=points, colour=colour, scale=scale
    )


def _coloured_lines(
    namespace: str, parts: Sequence[tuple[NDArray[np.float64], drawing.RGBA]], width: float
) -> drawing.DrawnMarker:
    """Segments (S, 2, 3) in a colour of their own, all in one marker."""
    segments = np.concatenate([np.empty((0, 2, 3)), *(part for part, _ in parts)])
    counts = [2 * len(part) for part, _ in parts]
    colours = np.array([colour for _, colour in parts], np.float32).reshape(-1, 4)
    return drawing.DrawnMarker(
        namespace,
        Marker.LINE_LIST,
        points=segments.reshape(-1, 3),
        colours=np.repeat(colours, counts, axis=0),
        colour=UNKNOWN_COLOUR,
        scale=(width, 0.0, 0.0),
    )
