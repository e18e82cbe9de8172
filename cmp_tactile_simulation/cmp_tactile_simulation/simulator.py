"""A sensor that is pressed: contact, then what the camera sees of it and what is true.

In: a sensor, an indenter, poses or loads.
Out: frames with their truth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.cache.files import expanded_path
from cmp_tactile_processing.errors import ContactError, InputError
from cmp_tactile_processing.measured import (
    NS_PER_S,
    ForceField,
    Grid,
    SlipEstimate,
    SlipState,
    Surface,
)
from cmp_tactile_processing.processes import OnProgress
from cmp_tactile_processing.sensor.description import (
    DEFAULT_SENSOR,
    SensorDescription,
    load_sensor,
)
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import ContactState, Load, Pose
from cmp_tactile_simulation.indenter_shapes import Sphere
from cmp_tactile_simulation.indenters import Indenter, MeshIndenter
from cmp_tactile_simulation.neo_hookean_gel import elastomer_of
from cmp_tactile_simulation.rendering import Purpose, random_stream
from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import Checkerboard, Dots, PrintDefects, ink_of
from cmp_tactile_simulation.rendering.renderer import OpticalTruth, RenderedFrame, Renderer
from cmp_tactile_simulation.rendering.surface import DeformedSurface

Array = NDArray[np.float64]

DEFAULT_FRICTION, MAX_FRICTION = 0.6, 10.0
DEFAULT_RADIUS_M = 4e-3
# Above the gel, where an indenter waits.
CLEARANCE_M = 1e-3
# Recordings of the same scene are to be the same bytes, whenever they are made.
FIRST_STAMP_NS = 1_750_000_000 * NS_PER_S


def force_field(
    contact: ContactSimulation, state: ContactState, sensor: SensorDescription
) -> ForceField:
    """Force of a contact that it solved on the gel, gel frame, on all contact nodes.

    position: the undeformed nodes.  wrench: about the gel frame's origin, the forces acting at
    the nodes' deformed positions, so that it is what a force-torque sensor would show.
    centre_of_pressure: mean of the deformed positions of the nodes that touch, weighted by the
    force along z, (3,) m.  contact_area: undeformed area of these nodes.
    """
    elastomer = contact.elastomer
    place = elastomer.node_position + state.displacement
    moment = np.cross(place, state.force).sum(axis=0)
    centre = np.full(3, np.nan)
    weight = state.force[:, 2]
    if state.contact.any() and weight.sum() != 0:
        centre = weight @ place / weight.sum()
    slip = slip_estimate(contact, state)
    return ForceField(
        rows=elastomer.nodes.rows,
        cols=elastomer.nodes.cols,
        position=elastomer.node_position,
        force=state.force,
        contact=state.contact,
        wrench=np.concatenate([state.resultant, moment]),
        contact_area=float(elastomer.node_area[state.contact].sum()),
        centre_of_pressure=centre,
        reference_point=np.zeros(3),
        slip_state=slip.state,
        slip=slip,
        valid_fraction=1.0,
        regularization=0.0,
        young=sensor.elastomer.young,
        poisson=sensor.elastomer.poisson,
    )


def slip_estimate(contact: ContactSimulation, state: ContactState) -> SlipEstimate:
    """What slides in a solved contact: exact, with Coulomb's coefficient where anything slides.

    traction_ratio: across over along the mean normal of the indenter where it touches, weighted
    by pressing force.
    """
    what, touches = slip_state(state), state.contact
    if what is SlipState.NO_CONTACT:
        return SlipEstimate(what)
    place = contact.elastomer.node_position[touches] + state.displacement[touches]
    force, slipping = state.force[touches], state.slipping[touches]
    normal = contact.indenter.distance(state.pose.to_indenter(place))[1] @ state.pose.rotation.T
    pressing = (force * normal).sum(axis=1)
    mean = pressing @ normal / np.linalg.norm(pressing @ normal)
    total = force.sum(axis=0)
    along = total - (total @ mean) * mean
    slides = bool(slipping.any())
    return SlipEstimate(
        state=what,
        slip_ratio=float(pressing[slipping].sum() / pressing.sum()),
        traction_ratio=float(np.linalg.norm(along) / (total @ mean)),
        friction_coefficient=contact.friction if slides else float("nan"),
        friction_std=0.0 if slides else float("nan"),
    )


def slip_state(state: ContactState) -> SlipState:
    """No contact, or whether none, some or all of the nodes that touch slide."""
    touching, sliding = int(state.contact.sum()), int(state.slipping.sum())
    if touching == 0:
        return SlipState.NO_CONTACT
    if sliding == 0:
        return SlipState.STICK
    return SlipState.FULL if sliding == touching else SlipState.INCIPIENT


@dataclass(frozen=True)
class Look:
    """How the pattern, the print's flaws and the camera make a picture.

    pattern_type: cmp (checkerboard) or dmp (dots).  samples: of a pixel along each direction.
    seed: of noise, flaws and dirt.
    """

    pattern_type: str = "cmp"
    camera: CameraSettings = field(default_factory=CameraSettings)
    defects: PrintDefects = field(default_factory=PrintDefects)
    samples: int = 4
    seed: int = 0


class SensorCamera:
    """What the camera of a sensor sees of its gel.

    truth: what is true of a picture.
    """

    def __init__(
        self, sensor: SensorDescription, look: Look, halved: SensorDescription | None = None
    ) -> None:
        """halved: the same sensor with half the pixels, to find one ray for 2 x 2 pixels."""
        self._sensor, self._look, self._is_halved = sensor, look, halved is not None
        samples = look.samples * (2 if halved else 1)
        self._renderer = Renderer(halved or sensor, self._ink(look), samples=samples)
        self.truth = OpticalTruth(sensor, None if halved else self._renderer.views)

    def use(self, look: Look) -> None:
        """Take the next pictures so; InputError for other samples of a pixel."""
        if look.samples != self._look.samples:
            msg = f"samples: found {look.samples}, expected {self._look.samples} as before"
            raise InputError(msg)
        self._look = look
        self._renderer.use(self._ink(look))

    def _ink(self, look: Look) -> Checkerboard | Dots:
        return ink_of(self._sensor.sheet, look.pattern_type, look.defects, look.seed)

    def picture(self, frame: int, surface: DeformedSurface) -> NDArray[np.uint8]:
        """Frame number `frame`, (H, W), of the gel with this surface."""
        rendered = self._renderer.render(surface)
        if self._is_halved:
            # Rendered finer than its pixels by 2, it has the whole frame's.
            rendered = RenderedFrame(rendered.grey, fineness=1)
        # Noise of a frame must not depend on the frames that were rendered before it.
        rng = random_stream(Purpose.FRAME_NOISE, self._look.seed, frame)
        return expose(rendered, self._look.camera, rng, self._look.seed)


@dataclass(frozen=True)
class Truth:
    """What is true of a frame, gel frame; forces act on the gel.

    displacement (rows, cols, 3) m: of the measured markers.
    traction (N, 3) Pa: force of each contact node over its undeformed area.
    wrench (6,) N and N m: about the gel frame's origin.  contact (N,): nodes that touch.
    pose: T_gel_indenter.
    """

    displacement: Array
    traction: Array
    wrench: Array
    contact: NDArray[np.bool_]
    pose: Pose


@dataclass(frozen=True)
class SimulatedFrame:
    """One camera frame and what is true of it.

    image (H, W) uint8: the whole camera frame.  grids: by view, px of the view; points that are
    not seen are missing.  surface, force: gel frame.  node_area (N,) m^2: of the force's nodes.
    pose: of the indenter, gel frame.
    """

    index: int
    stamp_ns: int
    phase: str
    image: NDArray[np.uint8]
    grids: Mapping[str, Grid]
    surface: Surface
    force: ForceField
    node_area: Array
    pose: Pose

    @property
    def truth(self) -> Truth:
        """What most want to know of it."""
        return Truth(
            self.surface.displacement,
            self.force.force / self.node_area[:, None],
            self.force.wrench,
            self.force.contact,
            self.pose,
        )


class Simulator:
    """A sensor that is pressed step by step: `press` moves the indenter and gives the frame.

    sensor: a description, its file or its packaged name.
    indenter: a shape of `indenter_shapes` (default: a ball of 4 mm radius), or the file of a closed
    mesh.  scale: from the mesh file's unit to m.  friction: Coulomb's coefficient.
    look: camera and print.  seed: of noise, flaws and dirt; default the look's.
    contact_nodes: along the longer side of the contact patch.  The gel's compliance for them is
    built once, in some 20 s, and kept in the cache folder.
    rate: frames per second; it matters for a gel that relaxes.
    progress: called with a text and the share that is done while the gel is built.

    The history counts, because friction holds what has stuck; `reset` forgets it.
    Raises InputError for a sensor, a mesh or a value that cannot be used, and ContactError for a
    number of nodes out of range.
    """

    def __init__(  # noqa: PLR0913 - keywords of a public door, all with defaults
        self,
        sensor: SensorDescription | str | Path = DEFAULT_SENSOR,
        indenter: Indenter | str | Path | None = None,
        *,
        friction: float = DEFAULT_FRICTION,
        scale: float = 1.0,
        look: Look | None = None,
        seed: int | None = None,
        contact_nodes: int = 40,
        rate: float = 30.0,
        cache_dir: Path | None = None,
        progress: OnProgress | None = None,
    ) -> None:
        self.sensor = sensor if isinstance(sensor, SensorDescription) else load_sensor(str(sensor))
        look = look or Look()
        self._look = look if seed is None else replace(look, seed=seed)
        self._rate = rate
        self.elastomer = elastomer_of(
            self.sensor, contact_nodes, cache_dir=cache_dir, progress=progress
        )
        self.use(Sphere(DEFAULT_RADIUS_M) if indenter is None else indenter, friction, scale)

    def use(
        self,
        indenter: Indenter | str | Path,
        friction: float = DEFAULT_FRICTION,
        scale: float = 1.0,
        look: Look | None = None,
    ) -> None:
        """Press with another indenter from now on, beginning with a gel that was never touched.

        look: of the pictures from now on, with as many samples of a pixel; default as before.
        """
        if look is not None:
            self.camera.use(look)
        if isinstance(indenter, str | Path):
            indenter = MeshIndenter.load(expanded_path(indenter), scale)
        if not 0 <= friction <= MAX_FRICTION:
            msg = f"friction: found {friction}, expected a number from 0 to {MAX_FRICTION:g}"
            raise InputError(msg)
        self.contact = ContactSimulation(self.elastomer, indenter, friction)
        self.reset()

    @cached_property
    def camera(self) -> SensorCamera:
        """Made when the first frame is rendered: the mechanics alone do without."""
        return SensorCamera(self.sensor, self._look)

    @property
    def state(self) -> ContactState:
        """The contact as it is now."""
        return self._state

    def reset(self) -> None:
        """A gel that was never touched, the indenter above its middle; frames count from 0."""
        self.elastomer.forget()
        self._index = 0
        at_rest = self.elastomer.node_position
        above = np.array([0.0, 0.0, at_rest[:, 2].max() + self.contact.indenter.reach])
        nothing, none = np.zeros_like(at_rest), np.zeros(len(at_rest), dtype=bool)
        far = np.full(len(at_rest), np.inf)
        self._state = ContactState(Pose(above), nothing, nothing, far, none, none)

    def press(  # noqa: PLR0913 - keywords of a public door, all with defaults
        self,
        pose: Pose | ArrayLike | None = None,
        *,
        depth: float | None = None,
        at: Sequence[float] = (0.0, 0.0),
        rotation_deg: Sequence[float] = (0.0, 0.0, 0.0),
        shear: Sequence[float] = (0.0, 0.0),
        twist_deg: float = 0.0,
        load: Load | None = None,
    ) -> SimulatedFrame:
        """The frame after the indenter has moved to a pose, to a depth, or until it bears a load.

        One of these is given:
        pose: T_gel_indenter, a Pose or a matrix (4, 4), m.
        depth: m below where the indenter, let down at (x, y) = `at` (m) and turned by rotation_deg
        (about the gel's x, then y, then z axis), first touches.  At that depth it is moved by
        `shear` (x, y), m, and turned by twist_deg about z.
        load: see Load; the indenter keeps its tilt, and stands at `at` if it does not touch yet.

        An indenter that touches goes straight to the new pose.  One that does not comes down upon
        it along z, and shears and twists after that.
        Raises InputError for anything else, and ContactError with the limit for a load that
        friction cannot carry, a contact that leaves the patch of contact nodes, and a press that
        the model of the gel cannot follow; the state then is as before.
        """
        if sum(item is not None for item in (pose, depth, load)) != 1:
            msg = "press: found none or several of pose, depth and load, expected one of them"
            raise InputError(msg)
        rotation = turned(rotation_deg)
        now = self._state
        self.elastomer.advance(now.force, 1 / self._rate)
        if load is not None:
            if not now.contact.any():
                now = self.contact.rest(self._touching(at, rotation))
            return self._reached(self.contact.press(now, load))
        if pose is not None:
            goals = [_pose(pose)]
        else:
            touching = self._touching(at, rotation)
            place = touching.position - (0.0, 0.0, depth or 0.0)
            aside = place + (*shear, 0.0)
            goals = [Pose(place, rotation), Pose(aside, turned((0, 0, twist_deg)) @ rotation)]
        if now.contact.any():
            return self._reached(self.contact.move(now, goals[-1]))
        now = self._free_at(goals[0]) if pose is not None else self.contact.rest(touching)
        for goal in goals:
            now = self.contact.move(now, goal)
        return self._reached(now)

    def release(self, clearance: float = CLEARANCE_M) -> SimulatedFrame:
        """The frame after the indenter has moved straight up, `clearance` m off the gel at rest."""
        now = self._state
        self.elastomer.advance(now.force, 1 / self._rate)
        up = self.contact.touch(now.pose).position + (0.0, 0.0, clearance)
        return self._reached(self.contact.move(now, Pose(up, now.pose.rotation)))

    def observe(
        self, state: ContactState, moved: Array, index: int, stamp_ns: int, phase: str = ""
    ) -> SimulatedFrame:
        """Frame number `index` of a state, and what is true of it.

        moved (rows, cols, 3) m: displacement of the elastomer's observers.
        """
        surface = DeformedSurface(self.sensor.pattern, self.elastomer.observers, moved)
        return SimulatedFrame(
            index=index,
            stamp_ns=stamp_ns,
            phase=phase,
            image=self.camera.picture(index, surface),
            grids=self.camera.truth.grids(surface),
            surface=self.camera.truth.surface(surface),
            force=force_field(self.contact, state, self.sensor),
            node_area=self.elastomer.node_area,
            pose=state.pose,
        )

    def _touching(self, at: Sequence[float], rotation: Array) -> Pose:
        return self.contact.touch(Pose(np.array([*at, 0.0]), rotation))

    def _free_at(self, goal: Pose) -> ContactState:
        """The free gel with the indenter at the goal, or where it touches on its way down to it."""
        try:
            return self.contact.rest(goal)
        except ContactError:
            return self.contact.rest(self.contact.touch(goal))

    def _reached(self, state: ContactState) -> SimulatedFrame:
        moved = self.elastomer.marker_displacement(state.force)
        stamp_ns = FIRST_STAMP_NS + round(self._index * NS_PER_S / self._rate)
        frame = self.observe(state, moved, self._index, stamp_ns)
        self._state, self._index = state, self._index + 1
        return frame


def turned(rotation_deg: Sequence[float]) -> Array:
    """Rotation matrix (3, 3) of turns about the fixed x, then y, then z direction, degrees."""
    return np.asarray(Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix())


def _pose(given: Pose | ArrayLike) -> Pose:
    """A pose, also of its matrix (4, 4); InputError for what is none."""
    if isinstance(given, Pose):
        return given
    matrix = np.asarray(given, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        msg = f"pose: found an array of shape {matrix.shape}, expected a finite matrix (4, 4)"
        raise InputError(msg)
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0:
        msg = "pose: found a matrix that is no rigid motion, expected T_gel_indenter"
        raise InputError(msg)
    return Pose(matrix[:3, 3], rotation)
