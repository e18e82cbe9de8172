"""RViz markers of the surface and of the force on it; NaN never gets into one."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker

from cmp_tactile_processing.force_field import ForceField
from cmp_tactile_processing.parameters import check_parameters, parameter
from cmp_tactile_processing.surface import Surface

__all__ = ["MarkerParameters", "force_markers", "surface_markers"]

MESH_ALPHA = 0.85
DISPLACEMENT_COLOUR = ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0)
FORCE_COLOUR = ColorRGBA(r=1.0, g=0.25, b=0.1, a=1.0)
CONTACT_COLOUR = ColorRGBA(r=0.2, g=1.0, b=0.2, a=1.0)
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
    line_width: float = parameter(
        0.0001, "width of arrows and outline", unit="m", low=1e-6, high=1.0
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
    """The force on each node as an arrow that ends there, and the outline of the contact.

    A press comes from outside of the gel: an arrow that began at the node would be hidden in it.
    """
    drawn = look.force_gain * field.force
    arrows = _arrows(field.position - drawn, drawn)
    return [
        _lines(header, "force", arrows, FORCE_COLOUR, look.line_width),
        _lines(header, "contact", contact_outline(field), CONTACT_COLOUR, 2 * look.line_width),
    ]


def contact_outline(field: ForceField) -> NDArray[np.float64]:
    """Ends (S, 2, 3), gel frame, m, of the borders between nodes in contact and nodes without.

    The border runs half-way between the nodes, around the cell that each node stands for.
    """
    if field.rows < 2 or field.cols < 2:
        return np.empty((0, 2, 3))
    corners = _cell_corners(field.position.reshape(field.rows, field.cols, 3))
    contact = np.pad(field.contact.reshape(field.rows, field.cols), 1)
    i, j = np.nonzero(contact[:, 1:] != contact[:, :-1])
    along_y = np.stack([corners[i - 1, j], corners[i, j]], axis=1)
    i, j = np.nonzero(contact[1:] != contact[:-1])
    along_x = np.stack([corners[i, j - 1], corners[i, j]], axis=1)
    outline = np.concatenate([along_y, along_x])
    return outline[np.isfinite(outline).all(axis=(1, 2))]


def _cell_corners(nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """(rows + 1, cols + 1, 3) points midway between the nodes (rows, cols, 3), and beyond them."""
    wide = np.pad(nodes, ((1, 1), (1, 1), (0, 0)), mode="reflect", reflect_type="odd")
    return (wide[:-1, :-1] + wide[:-1, 1:] + wide[1:, :-1] + wide[1:, 1:]) / 4


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
