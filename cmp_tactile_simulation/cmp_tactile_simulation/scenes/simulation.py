"""A scene, simulated frame by frame: contact, then what the camera sees of it and what is true."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import CmpTactileError, ContactError
from cmp_tactile_processing.measured import (
    ForceField,
    Grid,
    SlipEstimate,
    SlipState,
    Surface,
    SurfaceGrid,
)
from cmp_tactile_processing.processes import OnProgress
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import ContactState, Load, Pose
from cmp_tactile_simulation.neo_hookean_gel import elastomer_of
from cmp_tactile_simulation.rendering import Purpose, random_stream
from cmp_tactile_simulation.rendering.camera import expose
from cmp_tactile_simulation.rendering.ink import ink_of
from cmp_tactile_simulation.rendering.renderer import OpticalTruth, Renderer
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes import description

# Frames that rendering may lag behind the mechanics.
FRAMES_AHEAD = 2


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
class CameraView:
    """A frame (H, W) uint8 and its truth: grids by view, px of the view; surface, gel frame."""

    image: NDArray[np.uint8]
    grids: Mapping[str, Grid]
    surface: Surface


class SceneCamera:
    """Sensor optics, ink and camera settings of a scene.

    observers: the grid that displacements are given on.
    """

    def __init__(self, scene: description.Scene, observers: SurfaceGrid) -> None:
        self._scene = scene
        self._observers = observers
        ink = ink_of(scene.sensor.sheet, scene.pattern_type, scene.defects, scene.seed)
        self._renderer = Renderer(scene.sensor, ink, samples=scene.samples)
        self._truth = OpticalTruth(scene.sensor)

    def observe(self, frame: int, moved: NDArray[np.float64]) -> CameraView:
        """Frame number `frame` and its truth.

        moved (rows, cols, 3) m: displacement of the observers.
        """
        scene = self._scene
        surface = DeformedSurface(scene.sensor.pattern, self._observers, moved)
        # Noise of a frame must not depend on the frames that were rendered before it.
        rng = random_stream(Purpose.FRAME_NOISE, scene.seed, frame)
        return CameraView(
            image=expose(self._renderer.render(surface), scene.camera, rng, scene.seed),
            grids=self._truth.grids(surface),
            surface=self._truth.surface(surface),
        )


@dataclass(frozen=True)
class MechanicalState:
    """What the next frame depends on beside the elastomer's past; frame -1 is before the first."""

    frame: int
    contact: ContactState
    phase_start: description.PhaseStart


@dataclass(frozen=True)
class SimulatedFrame:
    """One camera frame and what is true of it.

    image (H, W) uint8: the whole camera frame.  grids: by view, px of the view; points that are
    not seen are missing.  surface, force: gel frame.  pose: of the indenter, gel frame.
    """

    index: int
    stamp_ns: int
    phase: str
    image: NDArray[np.uint8]
    grids: Mapping[str, Grid]
    surface: Surface
    force: ForceField
    pose: Pose


class Simulation:
    """Elastomer, indenter and camera of a scene, ready to run.

    cache_dir: of the elastomer's compliance.  progress: called with a text and the fraction done
    while it is built.  Raises ContactError for a scene that cannot be run.
    """

    def __init__(
        self,
        scene: description.Scene,
        cache_dir: Path | None = None,
        progress: OnProgress | None = None,
    ) -> None:
        self.scene = scene
        self.elastomer = elastomer_of(
            scene.sensor, scene.contact_nodes, cache_dir=cache_dir, progress=progress
        )
        self.contact = ContactSimulation(
            self.elastomer,
            description.indenter_of(scene.indenter, scene.start),
            scene.indenter.friction,
        )
        self._motion = description.Motion(scene.motion)
        self._phase_end: tuple[description.PhaseStart, Pose] | None = None

    @cached_property
    def camera(self) -> SceneCamera:
        """Made when the first frame is rendered: the mechanics alone do without."""
        return SceneCamera(self.scene, self.elastomer.observers)

    def start(self) -> MechanicalState:
        """The state before the first frame; ContactError where it is inside the gel."""
        self.elastomer.forget()
        pose = description.start_pose(self.scene.start, self.contact)
        return MechanicalState(-1, self.contact.rest(pose), description.PhaseStart(pose, Load(0.0)))

    def states(self, after: MechanicalState | None = None) -> Iterator[MechanicalState]:
        """The mechanics of all frames after the latest state, without pictures."""
        state = after or self.start()
        for frame in range(state.frame + 1, self.scene.frame_count):
            state = self._next(state, frame)
            yield state

    def frames(self) -> Generator[SimulatedFrame, None, None]:
        """All frames, in order.

        The mechanics of the next frames goes on while one is rendered.  Raises ContactError
        after the last frame that can be simulated, where that is not the scene's last.
        """
        state = self.start()
        pending: deque[Future[SimulatedFrame]] = deque()
        failure: CmpTactileError | None = None
        with ThreadPoolExecutor(1, thread_name_prefix="rendering") as pool:
            try:
                for frame in range(state.frame + 1, self.scene.frame_count):
                    state = self._next(state, frame)
                    with self._telling(frame):
                        moved = self.elastomer.marker_displacement(state.contact.force)
                    pending.append(pool.submit(self.observe, state, moved))
                    if len(pending) > FRAMES_AHEAD:
                        yield pending.popleft().result()
            except CmpTactileError as error:
                # The frames before are good.
                failure = error
            while pending:
                yield pending.popleft().result()
        if failure is not None:
            raise failure

    def observe(self, state: MechanicalState, moved: NDArray[np.float64]) -> SimulatedFrame:
        """The frame of a state, and what is true of it.

        moved (rows, cols, 3) m: displacement of the elastomer's observers.
        """
        view = self.camera.observe(state.frame, moved)
        return SimulatedFrame(
            index=state.frame,
            stamp_ns=self.scene.stamp_ns(state.frame),
            phase=self._motion.phase(state.frame).name,
            image=view.image,
            grids=view.grids,
            surface=view.surface,
            force=force_field(self.contact, state.contact, self.scene.sensor),
            pose=state.contact.pose,
        )

    @contextmanager
    def _telling(self, frame: int) -> Iterator[None]:
        """Let errors name the phase and the frame in which they come."""
        try:
            yield
        except ContactError as error:
            msg = f"phase {self._motion.phase(frame).name!r}, frame {frame}: {error}"
            raise ContactError(msg) from error

    def _next(self, state: MechanicalState, frame: int) -> MechanicalState:
        self.elastomer.advance(state.contact.force, 1 / self.scene.rate)
        with self._telling(frame):
            return self._solved(state, frame)

    def _solved(self, state: MechanicalState, frame: int) -> MechanicalState:
        begin = state.phase_start
        if self._motion.begins_phase(frame):
            begin = description.PhaseStart(
                state.contact.pose, self.contact.driven_load(state.contact)
            )
        goal, share = self._motion.phase(frame).goal, self._motion.share(frame)
        if isinstance(goal, description.Hold):
            contact = self.contact.move(state.contact, state.contact.pose)
        elif isinstance(goal, description.Press):
            contact = self.contact.press(
                state.contact, description.load_between(begin.load, goal, share)
            )
        else:
            end = self._end_of_phase(begin, goal)
            contact = self.contact.move(state.contact, begin.pose.towards(end, share))
        return MechanicalState(frame, contact, begin)

    def _end_of_phase(self, begin: description.PhaseStart, goal: description.Goal) -> Pose:
        """The goal's pose, worked out once: to look for where a mesh touches takes a second."""
        if self._phase_end is None or self._phase_end[0] is not begin:
            self._phase_end = begin, description.goal_pose(goal, begin.pose, self.contact)
        return self._phase_end[1]
