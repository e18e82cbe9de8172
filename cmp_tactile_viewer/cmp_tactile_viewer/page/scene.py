"""The 3-D scene of the page: gels, what they hold, simulated indenters, and the camera."""

from __future__ import annotations

import time
from collections.abc import Container, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.drawing import FORCE_COLOUR, contact_lines
from cmp_tactile_processing.force.advice import DOUBTS, flag_names
from cmp_tactile_processing.measured import Contact, ForceField, SlipState, Surface
from cmp_tactile_processing.surface.displacement import laid_on_known_surface
from cmp_tactile_viewer import meshes
from cmp_tactile_viewer.meshes import MM, ColourRange
from cmp_tactile_viewer.snapshot import Body, Pose, ShownSensor, Snapshot, Touch

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
Array = NDArray[np.float64]
FORCE_RGB: RGB = (_red, _green, _blue)
NOTHING = np.zeros((0, 2, 3))
# Viewers want at least one line: this one has no length.
NO_LINES = np.zeros((1, 2, 3))
HANDLE_MM, BALL_MM = 4.0, 0.4
# Beside the handle until it is dragged.
HANDLE_HINT = "drag the arrows to press and slide"
INDENTER_COLOUR = (240, 228, 66)
# Of several sensors, one after the other; behind each gel, mm.
HOUSING_COLOURS = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167))
HOUSING_MM = 8.0
BODY_COLOUR = (90, 170, 120)
# What stands before a gel must not hide it.
OPACITY = 0.3
# After so long without the mouse the handle is where the indenter is again.
RELEASED_S = 2.0
# Where the camera stands, seen from the gel; with several gels, x is the direction of their line.
DIRECTIONS = {"fit": (0.4, -0.8, 0.75), "top": (0.0, -1e-3, 1.0), "side": (0.0, -1.0, 0.06)}
PRESETS = tuple(DIRECTIONS)
UP = np.array((0.0, 0.0, 1.0))
# Share of the window's half that the gel fills, and what stands above the gel in the picture, mm.
FILLED, ABOVE_MM = 0.9, 2.0
# Height above the gel at which simulated indenters begin, mm.
INDENTER_MM = 8.0
# Around a gel that moves, mm: the camera goes farther away only where the gel leaves this room.
ROOM_MM = 15.0
# Windows whose ratio of width to height differs by less are of one shape.
SAME_SHAPE = 0.01


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

    def __init__(
        self, scene: viser.SceneApi, sensor: ShownSensor, housing: RGB | None = None
    ) -> None:
        """housing: colour of a box behind the gel, with the sensor's name; None for no box."""
        self.name = sensor.name
        self.range = ColourRange(COLOURS[0], LEAST_RANGE[COLOURS[0]])
        self._known = sensor.description.pattern.surface
        self._root = f"/{sensor.name}"
        self._frame = scene.add_frame(self._root, show_axes=False)
        _place(self._frame, sensor.mount)
        if housing is not None:
            _add_housing(scene, self._root, sensor, housing)
        self._bands = [
            _mesh(scene, f"{self._root}/surface/{number:02d}", (red, green, blue))
            for number, (red, green, blue) in enumerate(meshes.band_colours().tolist())
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
        self._reference: Array | None = None

    def draw(self, snapshot: Snapshot, look: Look) -> None:
        """Draw all that the snapshot holds; what it has not is taken off."""
        if snapshot.mount is not None:
            _place(self._frame, snapshot.mount)
        surface, force = snapshot.surface, snapshot.force
        if surface is not None:
            surface = laid_on_known_surface(surface, self._known)
            self._draw_surface(surface, force, look, snapshot.stamp_ns)
            self._draw_ghost(surface, look.at_rest)
        self._draw_arrows(surface, force, look)
        contacts = force.contacts if force is not None and look.contacts else ()
        for number, drawn in enumerate(self._contacts):
            if number < len(contacts) and force is not None:
                drawn.draw(contacts[number], force, look)
            else:
                drawn.hide()

    def _draw_surface(
        self, surface: Surface, force: ForceField | None, look: Look, stamp_ns: int
    ) -> None:
        values = _values(surface, force, look.colour)
        self.range.take(values, stamp_ns)
        points = meshes.refined_surface(surface)
        bands = meshes.colour_bands(points, meshes.refined(values), self.range.top)
        for handle, mesh in zip(self._bands, bands, strict=True):
            _set_mesh(handle, mesh)

    def _draw_ghost(self, surface: Surface, wanted: bool) -> None:
        self._ghost.visible = wanted
        if not wanted or self._reference is surface.reference:
            return
        known = self._reference
        self._reference = surface.reference
        if known is None or not np.array_equal(known, surface.reference, equal_nan=True):
            _set_mesh(self._ghost, meshes.whole_mesh(surface.reference))

    def _draw_arrows(self, surface: Surface | None, force: ForceField | None, look: Look) -> None:
        ends, colour = NOTHING, FORCE_RGB
        if look.arrows == ARROWS[0] and force is not None:
            ends = meshes.force_arrows(force, look.arrow_gain)
        elif look.arrows == ARROWS[1] and surface is not None:
            ends, colour = meshes.displacement_arrows(surface, look.arrow_gain), DISPLACEMENT_COLOUR
        self._arrows.colors = np.array(colour, np.uint8)
        self._arrows.points = ends.astype(np.float32)


class HeldBody:
    """Draws what the sensors hold."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._mesh = _mesh(scene, "/held_body", BODY_COLOUR)
        self._mesh.opacity, self._mesh.visible = OPACITY, False
        self._drawn: Array | None = None

    def draw(self, body: Body | None) -> None:
        """Draw it where it is, or take it off."""
        self._mesh.visible = body is not None
        if body is None:
            return
        if body.triangles is not self._drawn:
            self._drawn = body.triangles
            _set_mesh(self._mesh, meshes.triangle_mesh(body.triangles))
        _place(self._mesh, body.pose)


def _place(handle: viser.SceneNodeHandle, pose: Pose) -> None:
    handle.position, handle.wxyz = MM * np.array(pose.position), np.array(pose.orientation)


def _add_housing(scene: viser.SceneApi, root: str, sensor: ShownSensor, colour: RGB) -> None:
    width, height, thickness = MM * np.array(sensor.description.elastomer.size)
    scene.add_box(
        f"{root}/housing",
        colour,
        (width, height, HOUSING_MM),
        opacity=OPACITY,
        cast_shadow=False,
        receive_shadow=False,
        position=(0.0, 0.0, -thickness - HOUSING_MM / 2),
    )
    # Away from the texts of the contacts.
    back = (0.0, 0.0, -thickness - HOUSING_MM)
    scene.add_label(f"{root}/name", sensor.name, position=back, anchor="top-center")


def _values(surface: Surface, force: ForceField | None, colour: str) -> Array:
    """What a mesh is coloured by, (rows, cols)."""
    if colour == "displacement":
        return np.asarray(np.linalg.norm(surface.displacement, axis=-1))
    if colour == "depth":
        return -surface.displacement[..., 2]
    if colour == "pressure" and force is not None:
        return meshes.pressure_at(surface, force)
    return np.zeros(surface.displacement.shape[:2])


def _mesh(scene: viser.SceneApi, name: str, colour: RGB) -> viser.MeshHandle:
    empty = meshes.EMPTY
    return scene.add_mesh_simple(
        name,
        empty.vertices,
        empty.faces,
        color=colour,
        side="double",
        cast_shadow=False,
        receive_shadow=False,
    )


def _set_mesh(handle: viser.MeshHandle, mesh: meshes.Mesh) -> None:
    handle.vertices = mesh.vertices
    handle.faces = mesh.faces


class _DrawnContact:
    """Outline, centre of pressure, resultant with its error, moment and words of one contact."""

    def __init__(self, scene: viser.SceneApi, name: str) -> None:
        colour = meshes.slip_colour(SlipState.UNKNOWN)
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

    def draw(self, contact: Contact, force: ForceField, look: Look) -> None:
        """Draw it in the colour of its slip state; doubts of the force stand below its number."""
        colour, gain = meshes.slip_colour(contact.slip.state), look.arrow_gain
        for lines, ends in (
            (self._outline, meshes.outline(contact)),
            (self._moment, meshes.moment_lines(contact, force.reference_point, gain)),
        ):
            lines.visible = len(ends) > 0
            if len(ends):
                lines.points = ends.astype(np.float32)
                lines.colors = np.array(colour, np.uint8)
        arrow = meshes.contact_arrow(contact, gain)
        known = bool(np.isfinite(arrow).all())
        for part in (self._centre, self._resultant, self._text):
            part.visible = known
        self._text.visible = known and look.texts
        if known:
            doubts = flag_names(force.flags & DOUBTS, "\n! ")
            self._centre.position, self._centre.color = arrow[1], colour
            self._resultant.points = arrow[None].astype(np.float32)
            self._resultant.colors = np.array(colour, np.uint8)
            self._text.position = arrow[0] + (0.0, 0.0, 1.0)
            self._text.text = "\n".join(
                [*contact_lines(contact), *([f"! {doubts}"] if doubts else [])]
            )
        error = meshes.error_ellipsoid(contact, gain)
        self._error.visible = error is not None
        if error is not None:
            self._error.position, self._error.wxyz = error.centre, error.orientation
            x, y, z = np.maximum(error.half_axes, 1e-3).tolist()
            self._error.scale, self._error.color = (x, y, z), colour

    def hide(self) -> None:
        """Take it off."""
        for part in self._parts:
            part.visible = False


class DraggedIndenter:
    """A handle in the scene, and a ball where the indenter's origin really is.

    The indenter follows at its own speed, and stands still where the gel cannot be pressed further.
    """

    def __init__(self, scene: viser.SceneApi, root: str, touch: Touch, *, may_move: bool) -> None:
        self._touch, self._dragged_s = touch, -RELEASED_S
        self._ball = scene.add_icosphere(
            f"{root}/indenter", radius=BALL_MM, color=INDENTER_COLOUR, visible=False
        )
        self._handle: viser.TransformControlsHandle | None = None
        if may_move and touch.move is not None:
            self._handle = scene.add_transform_controls(
                f"{root}/handle", HANDLE_MM, depth_test=False, opacity=0.8, visible=False
            )
            self._handle.on_update(self._drag)
            self._hint = scene.add_label(f"{root}/handle/hint", HANDLE_HINT)

    def draw(self) -> None:
        """Show where it is."""
        pose = self._touch.pose
        if pose is None:
            return
        position, orientation = MM * np.array(pose.position), np.array(pose.orientation)
        self._ball.visible, self._ball.position = True, position
        if self._handle is not None and time.monotonic() - self._dragged_s > RELEASED_S:
            self._handle.visible = True
            self._handle.position, self._handle.wxyz = position, orientation

    def _drag(self, event: Any) -> None:
        if event.client is None or self._handle is None or self._touch.move is None:
            return
        self._dragged_s = time.monotonic()
        self._hint.visible = False
        x, y, z = (self._handle.position / MM).tolist()
        a, b, c, d = self._handle.wxyz.tolist()
        self._touch.move(Pose((x, y, z), (a, b, c, d)))


class Framing:
    """What the camera frames: a box around each gel, with room where that moves."""

    def __init__(self, sensors: Sequence[ShownSensor], dragged: Container[str] = ()) -> None:
        """dragged: names of the sensors whose indenter has a handle, which is framed as well."""
        several = len(sensors) > 1
        self._gels = {
            sensor.name: _corners(sensor, is_dragged=sensor.name in dragged, has_housing=several)
            for sensor in sensors
        }
        self._boxes = {
            sensor.name: _placed(self._gels[sensor.name], sensor.mount) for sensor in sensors
        }
        self._moved: set[str] = set()

    @property
    def points(self) -> Array:
        """Corners of the boxes, (8 n, 3) mm in the scene."""
        return np.concatenate([*self._boxes.values()])

    def follow(self, name: str, mount: Pose) -> bool:
        """Make room where a gel has left its box; whether it had."""
        gel, box = _placed(self._gels[name], mount), self._boxes[name]
        if name in self._moved:
            low, high = box.min(axis=0), box.max(axis=0)
            if (gel >= low).all() and (gel <= high).all():
                return False
            gel = np.concatenate([gel, box.clip(low + ROOM_MM, high - ROOM_MM)])
        self._moved.add(name)
        self._boxes[name] = _box(gel.min(axis=0) - ROOM_MM, gel.max(axis=0) + ROOM_MM)
        return True


def _corners(sensor: ShownSensor, *, is_dragged: bool, has_housing: bool) -> Array:
    """Of the box around a gel, its housing and what stands above it, (8, 3) mm, gel frame."""
    corners = MM * sensor.description.pattern.corners().reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    if has_housing:
        width, height, thickness = MM * np.array(sensor.description.elastomer.size)
        low = np.array((-width / 2, -height / 2, -thickness - HOUSING_MM))
        high = np.array((width / 2, height / 2, high[2]))
    above = INDENTER_MM + HANDLE_MM if is_dragged else ABOVE_MM
    return _box(low, high + (0.0, 0.0, above))


def _box(low: Array, high: Array) -> Array:
    return np.array(list(product(*zip(low, high, strict=True))))


def _placed(points: Array, pose: Pose) -> Array:
    w, x, y, z = pose.orientation
    turned = Rotation.from_quat((x, y, z, w)).apply(points)
    return np.asarray(turned + MM * np.array(pose.position))


def camera_position(points: Array, preset: str, fov_rad: float, aspect: float) -> Array:
    """From where all points are seen, looking at their middle; (3,) in the units of the points.

    fov_rad: of the window's height.  aspect: width by height.
    """
    middle = middle_of(points)
    x, y, z = DIRECTIONS[preset]
    line = _line(points)
    towards = np.array((x * line[0] - y * line[1], x * line[1] + y * line[0], z))
    towards /= np.linalg.norm(towards)
    right = np.cross(UP, towards)
    right /= np.linalg.norm(right)
    relative = points - middle
    half = FILLED * np.tan(fov_rad / 2)
    needed = (
        np.abs(relative @ right) / (half * aspect),
        np.abs(relative @ np.cross(towards, right)) / half,
    )
    distance = float((np.maximum(*needed) + relative @ towards).max())
    return np.asarray(middle + distance * towards)


def middle_of(points: Array) -> Array:
    """Middle of the box around the points, (3,)."""
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)


def _line(points: Array) -> Array:
    """Horizontal direction from the first gel to the last, (2,); x where there is one gel."""
    gels = points.reshape(-1, 8, 3).mean(axis=1)
    apart = (gels[-1] - gels[0])[:2]
    length = float(np.linalg.norm(apart))
    return np.asarray(apart / length) if length > 0 else np.array((1.0, 0.0))


class Aim:
    """One browser's camera: aimed by a preset, and again when its window gets another shape.

    A camera that the user has moved stays where it is.
    """

    def __init__(self, client: viser.ClientHandle, framing: Framing) -> None:
        self._camera, self._framing = client.camera, framing
        self.take(PRESETS[0])
        client.camera.on_update(self._on_update)

    def take(self, preset: str) -> None:
        """Turn the camera as one of PRESETS."""
        camera, points = self._camera, self._framing.points
        self._preset, self._aspect = preset, camera.aspect
        self._position = camera_position(points, preset, camera.fov, camera.aspect)
        # A new position moves `look_at` along: set it afterwards.
        camera.position = self._position
        camera.look_at, camera.up_direction = middle_of(points), UP

    def follow(self) -> None:
        """Frame what has moved, unless the user has moved the camera."""
        if np.allclose(self._camera.position, self._position, rtol=0.0, atol=0.1):
            self.take(self._preset)

    def _on_update(self, camera: viser.CameraHandle) -> None:
        if abs(camera.aspect / self._aspect - 1.0) > SAME_SHAPE:
            self.follow()
