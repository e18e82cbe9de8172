"""The gel of one sensor in the scene: surface, arrows, contacts, resultant wrench."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from cmp_tactile_processing.drawing import FORCE_COLOUR, contact_lines
from cmp_tactile_processing.measured import Contact, ForceField, SlipState, Surface
from cmp_tactile_processing.surface.displacement import laid_on_known_surface
from cmp_tactile_viewer.scene import forces, surface_mesh
from cmp_tactile_viewer.scene.surface_mesh import MM, ColourRange
from cmp_tactile_viewer.snapshot import ShownSensor, Snapshot

COLOURS = ("displacement", "depth", "pressure", "none")
ARROWS = ("force at the nodes", "displacement", "none")
# At least so much makes the colours end, m and Pa: noise of a gel at rest stays dark.
LEAST_RANGE = {"displacement": 1e-4, "depth": 1e-4, "pressure": 5e3}
UNITS = {"displacement": (1e3, "mm"), "depth": (1e3, "mm"), "pressure": (1e-3, "kPa")}
GHOST_COLOUR, DISPLACEMENT_COLOUR = (150, 150, 160), (40, 40, 45)
# The surface at rest appears where the gel is pressed below it, not where the two are the same.
BELOW = (0.0, 0.0, -0.05)
MOST_CONTACTS = 4
_red, _green, _blue, _ = (round(255 * part) for part in FORCE_COLOUR)
RGB = tuple[int, int, int]
FORCE_RGB: RGB = (_red, _green, _blue)
NOTHING = np.zeros((0, 2, 3))
# Viewers want at least one line: this one has no length.
NO_LINES = np.zeros((1, 2, 3))


@dataclass(frozen=True)
class Look:
    """What is drawn, and how long the arrows are."""

    colour: str = COLOURS[0]
    arrows: str = ARROWS[0]
    arrow_gain: float = 1.0
    at_rest: bool = True
    contacts: bool = True
    texts: bool = True


class Gel:
    """Draws snapshots of one sensor below a node of the scene that has its pose."""

    def __init__(self, scene: viser.SceneApi, sensor: ShownSensor) -> None:
        self.name = sensor.name
        self.range = ColourRange(COLOURS[0], LEAST_RANGE[COLOURS[0]])
        self._known = sensor.description.pattern.surface
        self._root = f"/{sensor.name}"
        scene.add_frame(
            self._root,
            show_axes=False,
            position=MM * np.array(sensor.position),
            wxyz=np.array(sensor.orientation),
        )
        self._bands = [
            _mesh(scene, f"{self._root}/surface/{number:02d}", (red, green, blue))
            for number, (red, green, blue) in enumerate(surface_mesh.band_colours().tolist())
        ]
        self._ghost = _mesh(scene, f"{self._root}/at_rest", GHOST_COLOUR)
        self._ghost.wireframe, self._ghost.opacity, self._ghost.position = True, 0.35, BELOW
        self._arrows = scene.add_arrows(
            f"{self._root}/arrows",
            NOTHING,
            FORCE_RGB,
            shaft_radius=0.06,
            head_radius=0.15,
            head_length=0.35,
        )
        self._contacts = [
            _DrawnContact(scene, f"{self._root}/contact_{number}")
            for number in range(MOST_CONTACTS)
        ]
        self._reference: NDArray[np.float64] | None = None

    def draw(self, snapshot: Snapshot, look: Look) -> None:
        """Draw all that the snapshot holds; what it has not is taken off."""
        surface, force = snapshot.surface, snapshot.force
        if surface is not None:
            surface = laid_on_known_surface(surface, self._known)
            self._draw_surface(surface, force, look, snapshot.stamp_ns)
            self._draw_ghost(surface, look.at_rest)
        self._draw_arrows(surface, force, look)
        contacts = force.contacts if force is not None and look.contacts else ()
        for number, drawn in enumerate(self._contacts):
            if number < len(contacts) and force is not None:
                drawn.draw(contacts[number], force.reference_point, look)
            else:
                drawn.hide()

    def _draw_surface(
        self, surface: Surface, force: ForceField | None, look: Look, stamp_ns: int
    ) -> None:
        values = _values(surface, force, look.colour)
        self.range.take(values, stamp_ns)
        points = surface_mesh.refined_surface(surface)
        meshes = surface_mesh.colour_bands(points, surface_mesh.refined(values), self.range.top)
        for handle, mesh in zip(self._bands, meshes, strict=True):
            _set_mesh(handle, mesh)

    def _draw_ghost(self, surface: Surface, wanted: bool) -> None:
        self._ghost.visible = wanted
        if not wanted or self._reference is surface.reference:
            return
        known = self._reference
        self._reference = surface.reference
        if known is None or not np.array_equal(known, surface.reference, equal_nan=True):
            _set_mesh(self._ghost, surface_mesh.whole_mesh(surface.reference))

    def _draw_arrows(self, surface: Surface | None, force: ForceField | None, look: Look) -> None:
        ends, colour = NOTHING, FORCE_RGB
        if look.arrows == ARROWS[0] and force is not None:
            ends = forces.force_arrows(force, look.arrow_gain)
        elif look.arrows == ARROWS[1] and surface is not None:
            ends, colour = forces.displacement_arrows(surface, look.arrow_gain), DISPLACEMENT_COLOUR
        self._arrows.colors = np.array(colour, np.uint8)
        self._arrows.points = ends.astype(np.float32)


def _values(surface: Surface, force: ForceField | None, colour: str) -> NDArray[np.float64]:
    """What a mesh is coloured by, (rows, cols)."""
    if colour == "displacement":
        return np.asarray(np.linalg.norm(surface.displacement, axis=-1))
    if colour == "depth":
        return -surface.displacement[..., 2]
    if colour == "pressure" and force is not None:
        return surface_mesh.pressure_at(surface, force)
    return np.zeros(surface.displacement.shape[:2])


def _mesh(scene: viser.SceneApi, name: str, colour: RGB) -> viser.MeshHandle:
    empty = surface_mesh.EMPTY
    return scene.add_mesh_simple(
        name,
        empty.vertices,
        empty.faces,
        color=colour,
        side="double",
        cast_shadow=False,
        receive_shadow=False,
    )


def _set_mesh(handle: viser.MeshHandle, mesh: surface_mesh.Mesh) -> None:
    handle.vertices = mesh.vertices
    handle.faces = mesh.faces


class _DrawnContact:
    """Outline, centre of pressure, resultant with its error, moment and words of one contact."""

    def __init__(self, scene: viser.SceneApi, name: str) -> None:
        colour = forces.slip_colour(SlipState.UNKNOWN)
        self._outline = scene.add_line_segments(
            f"{name}/outline", NO_LINES, np.array(colour), thickness=4.0, thickness_units="screen"
        )
        self._moment = scene.add_line_segments(
            f"{name}/moment", NO_LINES, np.array(colour), thickness=3.0, thickness_units="screen"
        )
        self._centre = scene.add_icosphere(f"{name}/centre_of_pressure", radius=0.3, color=colour)
        self._resultant = scene.add_arrows(
            f"{name}/resultant",
            NO_LINES,
            colour,
            shaft_radius=0.18,
            head_radius=0.45,
            head_length=0.9,
        )
        self._error = scene.add_icosphere(
            f"{name}/error", radius=1.0, color=colour, opacity=0.35, cast_shadow=False
        )
        self._text = scene.add_label(f"{name}/text", "", anchor="bottom-center")
        self._parts = (
            self._outline, self._moment, self._centre, self._resultant, self._error, self._text
        )  # fmt: skip
        self.hide()

    def draw(self, contact: Contact, moment_point: NDArray[np.float64], look: Look) -> None:
        """Draw it in the colour of its slip state."""
        colour, gain = forces.slip_colour(contact.slip.state), look.arrow_gain
        for lines, ends in (
            (self._outline, forces.outline(contact)),
            (self._moment, forces.moment_lines(contact, moment_point, gain)),
        ):
            lines.visible = len(ends) > 0
            if len(ends):
                lines.points = ends.astype(np.float32)
                lines.colors = np.array(colour, np.uint8)
        arrow = forces.contact_arrow(contact, gain)
        known = bool(np.isfinite(arrow).all())
        for part in (self._centre, self._resultant, self._text):
            part.visible = known
        self._text.visible = known and look.texts
        if known:
            self._centre.position, self._centre.color = arrow[1], colour
            self._resultant.points = arrow[None].astype(np.float32)
            self._resultant.colors = np.array(colour, np.uint8)
            self._text.position = arrow[0] + (0.0, 0.0, 1.0)
            self._text.text = "\n".join(contact_lines(contact))
        error = forces.error_ellipsoid(contact, gain)
        self._error.visible = error is not None
        if error is not None:
            self._error.position, self._error.wxyz = error.centre, error.orientation
            x, y, z = np.maximum(error.half_axes, 1e-3).tolist()
            self._error.scale, self._error.color = (x, y, z), colour

    def hide(self) -> None:
        """Take it off."""
        for part in self._parts:
            part.visible = False
