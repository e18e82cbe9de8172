"""RViz markers of the surface and of the force on it; NaN never gets into one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker

from cmp_tactile_processing.force_field import Contact, ForceField, SlipState
from cmp_tactile_processing.parameters import check_parameters, parameter
from cmp_tactile_processing.surface import Surface

__all__ = ["MarkerParameters", "force_markers", "surface_markers"]

MESH_ALPHA = 0.85
DISPLACEMENT_COLOUR = ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0)
FORCE_COLOUR = ColorRGBA(r=1.0, g=0.25, b=0.1, a=1.0)
UNKNOWN_COLOUR = ColorRGBA(r=0.75, g=0.85, b=1.0, a=1.0)
SLIP_COLOURS = {
    SlipState.UNKNOWN: UNKNOWN_COLOUR,
    SlipState.NO_CONTACT: UNKNOWN_COLOUR,
    SlipState.STICK: ColorRGBA(r=0.2, g=1.0, b=0.2, a=1.0),
    SlipState.INCIPIENT: ColorRGBA(r=1.0, g=0.75, b=0.1, a=1.0),
    SlipState.FULL: ColorRGBA(r=1.0, g=0.1, b=0.5, a=1.0),
}
SLIP_WORDS = {
    SlipState.UNKNOWN: "",
    SlipState.NO_CONTACT: "",
    SlipState.STICK: "sticks",
    SlipState.INCIPIENT: "begins to slip",
    SlipState.FULL: "slips",
}
# So many texts are written or deleted each time: those of before need not be remembered.
MOST_TEXTS = 8
# Height of a text's middle over the contact, in letters: it is of three lines.
TEXT_HEIGHT = 3.0
HEAD_LENGTH, HEAD_HALF_WIDTH = 0.25, 0.1
# Arrows shorter than this, as drawn, would only be dots.
SHORTEST_ARROW_M = 2e-5


def _palette() -> list[ColorRGBA]:
    bgr = cv2.applyColorMap(np.arange(256, dtype=np.uint8), cv2.COLORMAP_VIRIDIS)
    return [
        ColorRGBA(r=r, g=g, b=b, a=MESH_ALPHA) for b, g, r in (bgr.reshape(-1, 3) / 255.0).tolist()
    ]


DEPTH_PALETTE = _palette()


@dataclass(frozen=True)
class MarkerParameters:
    """How the markers are drawn."""

    displacement_gain: float = parameter(
        1.0, "drawn length of a displacement arrow per displacement; 0: none", low=0.0, high=1e3
    )
    force_gain: float = parameter(
        0.05,
        "drawn length of a force arrow per force on a node; 0: none",
        unit="m/N",
        low=0.0,
        high=1e3,
    )
    depth_range: float = parameter(
        0.001, "indentation at which the colour of the mesh ends", unit="m", low=1e-6, high=1.0
    )
    resultant_gain: float = parameter(
        0.001,
        "drawn length of the arrow of a contact's force per force; 0: none",
        unit="m/N",
        low=0.0,
        high=1e3,
    )
    contact_text: bool = parameter(
        True, "whether normal force, area and slip state are written at each contact"
    )
    text_size: float = parameter(0.0008, "height of the letters", unit="m", low=1e-6, high=1.0)
    line_width: float = parameter(
        0.0001,
        "width of arrows, half that of outlines, a third of that of resultants",
        low=1e-6,
        high=1.0,
    )

    def __post_init__(self) -> None:
        check_parameters(self, "markers")


def surface_markers(surface: Surface, header: Header, look: MarkerParameters) -> list[Marker]:
    """The mesh coloured by indentation, and the displacement arrows, from reference to surface."""
    arrows = _arrows(
        surface.reference.reshape(-1, 3),
        look.displacement_gain * surface.displacement.reshape(-1, 3),
    )
    return [
        _mesh(surface, header, look.depth_range),
        _lines(header, "displacement", arrows, DISPLACEMENT_COLOUR, look.line_width),
    ]


def force_markers(field: ForceField, header: Header, look: MarkerParameters) -> list[Marker]:
    """Arrows of the force on the nodes in contact, and what `_contact_markers` draws of each.

    A press comes from outside of the gel: an arrow that began at the node would be hidden in it.
    """
    drawn = look.force_gain * field.force[field.contact]
    arrows = _arrows(field.position[field.contact] - drawn, drawn)
    return [
        _lines(header, "force", arrows, FORCE_COLOUR, look.line_width),
        *_contact_markers(field.contacts, header, look),
    ]


def _contact_markers(
    contacts: Sequence[Contact], header: Header, look: MarkerParameters
) -> list[Marker]:
    """Outline, resultant and text of each contact, in the colour of its slip state."""
    shown = [(item, SLIP_COLOURS[item.slip.state]) for item in contacts]
    outlines = [(_closed(item.outline), colour) for item, colour in shown]
    resultants = [(_resultant(item, look.resultant_gain), colour) for item, colour in shown]
    texts = shown[:MOST_TEXTS] if look.contact_text else []
    markers = [
        _coloured_lines(header, "contact", outlines, 2 * look.line_width),
        _coloured_lines(header, "resultant", resultants, 3 * look.line_width),
    ]
    for number in range(MOST_TEXTS):
        marker = _marker(header, "contact_text", Marker.TEXT_VIEW_FACING)
        marker.id = number
        if number < len(texts) and np.isfinite(texts[number][0].centre_of_pressure).all():
            contact, marker.color = texts[number]
            x, y, z = contact.centre_of_pressure.tolist()
            marker.pose.position = Point(x=x, y=y, z=z + TEXT_HEIGHT * look.text_size)
            marker.scale.z = look.text_size
            marker.text = contact_text(contact)
        else:
            marker.action = Marker.DELETE
        markers.append(marker)
    return markers


def contact_text(contact: Contact) -> str:
    """What is written at a contact: normal force and its deviation, area and slip state.

    ASCII: RViz has no other letters.
    """
    variance = contact.covariance[2, 2]
    spread = f" +/- {np.sqrt(variance):.2f}" if variance >= 0 else ""
    lines = [f"Fz {contact.wrench[2]:.2f}{spread} N", f"{contact.area * 1e6:.1f} mm^2"]
    if contact.at_border:
        lines[-1] += ", at the border"
    word = SLIP_WORDS[contact.slip.state]
    if word:
        lines.append(word)
    return "\n".join(lines)


def _closed(outline: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sides (S, 2, 3) of a closed polygon (S, 3)."""
    sides = np.stack([outline, np.roll(outline, -1, axis=0)], axis=1)
    return np.asarray(sides[np.isfinite(sides).all(axis=(1, 2))])


def _resultant(contact: Contact, gain: float) -> NDArray[np.float64]:
    """The arrow of a contact's force, which ends at its centre of pressure."""
    drawn = gain * contact.wrench[None, :3]
    return _arrows(contact.centre_of_pressure - drawn, drawn)


def _mesh(surface: Surface, header: Header, depth_range: float) -> Marker:
    """Two triangles for each cell of which all four corners are known."""
    marker = _marker(header, "surface", Marker.TRIANGLE_LIST)
    marker.scale.x = marker.scale.y = marker.scale.z = 1.0
    rows, cols = surface.shape.corners
    finite = np.isfinite(surface.position).all(axis=-1) & np.isfinite(surface.displacement[..., 2])
    number = np.arange(rows * cols).reshape(rows, cols)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    cells = np.stack([a, b, c, a, c, d], axis=-1)
    vertices = cells[finite.ravel()[cells].all(axis=-1)].ravel().tolist()
    depth = np.clip(np.nan_to_num(-surface.displacement[..., 2].ravel() / depth_range), 0, 1)
    shade = np.round(depth * (len(DEPTH_PALETTE) - 1)).astype(int).tolist()
    points = [Point(x=x, y=y, z=z) for x, y, z in surface.position.reshape(-1, 3).tolist()]
    marker.points = [points[vertex] for vertex in vertices]
    marker.colors = [DEPTH_PALETTE[shade[vertex]] for vertex in vertices]
    return _empty_deletes(marker)


def _lines(
    header: Header,
    namespace: str,
    segments: NDArray[np.float64],
    colour: ColorRGBA,
    width: float,
) -> Marker:
    marker = _marker(header, namespace, Marker.LINE_LIST)
    marker.scale.x = width
    marker.color = colour
    marker.points = [Point(x=x, y=y, z=z) for x, y, z in segments.reshape(-1, 3).tolist()]
    return _empty_deletes(marker)


def _coloured_lines(
    header: Header,
    namespace: str,
    parts: Sequence[tuple[NDArray[np.float64], ColorRGBA]],
    width: float,
) -> Marker:
    """Segments (S, 2, 3) in a colour of their own, all in one marker."""
    segments = np.concatenate([np.empty((0, 2, 3)), *(part for part, _ in parts)])
    marker = _lines(header, namespace, segments, UNKNOWN_COLOUR, width)
    marker.colors = [colour for part, colour in parts for _ in range(2 * len(part))]
    return marker


def _arrows(tails: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ends (3 A, 2, 3) of the shaft and the two barbs of each arrow that is finite and not tiny."""
    length = np.linalg.norm(vectors, axis=-1)
    drawn = np.isfinite(tails).all(axis=-1) & (length > SHORTEST_ARROW_M)
    tails, vectors, length = tails[drawn], vectors[drawn], length[drawn, None]
    side = np.cross(vectors, (0.0, 0.0, 1.0))
    # An arrow along z has no side in the xy plane; x serves as well.
    flat = np.linalg.norm(side, axis=-1) < 1e-6 * length[:, 0]
    side[flat] = (1.0, 0.0, 0.0)
    side *= HEAD_HALF_WIDTH * length / np.linalg.norm(side, axis=-1, keepdims=True)
    tips = tails + vectors
    back = tips - HEAD_LENGTH * vectors
    ends = [(tails, tips), (tips, back + side), (tips, back - side)]
    return np.stack([np.stack(pair, axis=1) for pair in ends], axis=1).reshape(-1, 2, 3)


def _marker(header: Header, namespace: str, marker_type: int) -> Marker:
    marker = Marker(header=header, ns=namespace, id=0, type=marker_type, action=Marker.ADD)
    marker.pose.orientation.w = 1.0
    return marker


def _empty_deletes(marker: Marker) -> Marker:
    """RViz reports a list without points as an error; nothing to show is a deleted marker."""
    if not marker.points:
        marker.action = Marker.DELETE
    return marker
