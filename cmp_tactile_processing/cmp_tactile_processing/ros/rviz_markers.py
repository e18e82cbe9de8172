"""RViz markers of the surface and of the force on it; NaN never gets into one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
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
    grasp_line,
    mesh_vertices,
    turning_arrow,
)
from cmp_tactile_processing.force.grasp import GraspState
from cmp_tactile_processing.measured import Contact, ForceField, Surface
from cmp_tactile_processing.ros.rviz import RGBA, DrawnMarker, Page, clear_places, stacked
from cmp_tactile_processing.sensor.parameters import Parameters, parameter

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
# Of a grasp: diameter of its centre, width of its arrows, height of its text and place above it.
GRASP_CENTRE_M = 1.5e-3
GRASP_ARROW_M = 4e-4
GRASP_TEXT_M = 1.2e-3
GRASP_TEXT_ABOVE_M = 0.02


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


def grasp_markers(state: GraspState, force_gain: float) -> list[DrawnMarker]:
    """Centre of contact, arrows of grip and load, and a line of text, in the frame of the state.

    force_gain: length of an arrow per force, m/N.
    """
    centre, colour = state.centre_of_contact, SLIP_COLOURS[state.slip_state]
    if not (state.usable and np.isfinite(centre).all()):
        return []
    grip = force_gain * state.grip_force * np.outer([-1.0, 1.0], state.grip_axis)
    load = force_gain * state.load[None, :3]
    x, y, z = centre.tolist()
    return [
        DrawnMarker(
            "centre_of_contact",
            Marker.SPHERE_LIST,
            points=centre[None],
            colour=colour,
            scale=(GRASP_CENTRE_M,) * 3,
        ),
        _lines("grip", arrows(centre + np.zeros((2, 3)), grip), colour, GRASP_ARROW_M),
        _lines("load", arrows(centre - load, load), FORCE_COLOUR, GRASP_ARROW_M),
        DrawnMarker(
            "grasp_text",
            Marker.TEXT_VIEW_FACING,
            colour=colour,
            scale=(GRASP_TEXT_M, 0.0, GRASP_TEXT_M),
            position=(x, y, z + GRASP_TEXT_ABOVE_M),
            text=grasp_line(state),
        ),
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
