"""Plays a grasp: moves the gripper, and gives frames of both fingertips with their truth."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ContactError
from cmp_tactile_processing.measured import NS_PER_S
from cmp_tactile_processing.processes import OnProgress, no_progress
from cmp_tactile_simulation.contact.laws import Pose
from cmp_tactile_simulation.grasp.scene import SIDES, GraspPhase, GraspScene
from cmp_tactile_simulation.grasp.world import (
    GRIP,
    LIFT,
    OBJECT,
    SHAKE,
    TILT,
    World,
    gripper_model,
)
from cmp_tactile_simulation.indenters import Indenter, MeshIndenter
from cmp_tactile_simulation.scenes.description import INDENTERS
from cmp_tactile_simulation.simulator import FIRST_STAMP_NS, Look, SimulatedFrame, Simulator

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GraspFrame:
    """A moment of a grasp.

    fingers: frames of the fingertips, by side.  wrenches (6,) N and N m: true ones on the gels at
    that moment, by side, gel frames.  fingertips, held: poses in the world, gel frames and object.
    controls: of the actuators.
    """

    index: int
    stamp_ns: int
    phase: str
    fingers: Mapping[str, SimulatedFrame]
    wrenches: Mapping[str, Array]
    fingertips: Mapping[str, Pose]
    held: Pose
    mass: float
    controls: Mapping[str, float]


class Grasp:
    """A grasp that can be played once.

    pictures: whether cameras see it; without, `fingers` are empty.
    Raises InputError without MuJoCo, and for a scene that cannot be built; ContactError where the
    object is inside a fingertip at the start.
    """

    def __init__(
        self,
        scene: GraspScene,
        *,
        pictures: bool = True,
        cache_dir: Path | None = None,
        progress: OnProgress = no_progress,
    ) -> None:
        self.scene = scene
        self.world = World(gripper_model(scene), SIDES, OBJECT, scene.gripper.speed, scene.keyframe)
        self._pictures = pictures
        self._fingers = {
            side: Simulator(
                scene.fingertip,
                _body(scene, self.world.pose(number)),
                friction=scene.object.friction,
                look=Look(camera=scene.camera, samples=scene.samples),
                seed=number,
                contact_nodes=scene.contact_nodes,
                rate=scene.rate,
                cache_dir=cache_dir,
                progress=progress,
            )
            for number, side in enumerate(SIDES)
        }
        self.world.hold([finger.contact for finger in self._fingers.values()])

    def frames(self) -> Iterator[GraspFrame]:
        """The frames, in order; ContactError with the time where a gel cannot follow."""
        scene, world = self.scene, self.world
        step = world.model.opt.timestep
        period, index = 1 / scene.rate, 0
        now, phase = 0.0, ""
        try:
            for now, phase, controls, force, mass in self._commands(step):
                if now >= index * period - step / 2:
                    # The picture shows the gel as it is at this moment.
                    world.solve(always=True)
                    yield self._frame(index, phase, controls, mass)
                    index += 1
                world.step(controls, force, mass)
        except ContactError as error:
            msg = f"{scene.name}: {now:.2f} s, {phase}: {error}"
            raise ContactError(msg) from None

    def _commands(self, step: float) -> Iterator[tuple[float, str, dict[str, float], Array, float]]:
        """For each time step: time, phase, controls, force on the object and its mass."""
        now, mass, pushed = 0.0, self.scene.mass, np.zeros(6)
        held: dict[str, float] = {}
        for phase in self.scene.motion:
            goal = _goal(phase, held)
            before = {name: held.get(name, self.world.control(name)) for name in goal}
            heavier = mass if phase.mass is None else phase.mass
            push = np.array([*phase.force, *phase.torque])
            count = max(1, round(phase.duration / step))
            for number in range(1, count + 1):
                share = number / count
                smooth = share * share * (3 - 2 * share)
                controls = {
                    name: (1 - smooth) * before[name] + smooth * value
                    for name, value in goal.items()
                }
                if phase.shake:
                    angle = 2 * math.pi * phase.shake_hz * number * step
                    controls[SHAKE] = phase.shake * math.sin(angle)
                force = (1 - smooth) * pushed + smooth * push
                yield now, phase.name, controls, force, mass + (heavier - mass) * share
                now += step
            held, mass, pushed = goal, heavier, push

    def _frame(
        self, index: int, phase: str, controls: Mapping[str, float], mass: float
    ) -> GraspFrame:
        world = self.world
        stamp = FIRST_STAMP_NS + round(index * NS_PER_S / self.scene.rate)
        fingers = {}
        for number, (side, finger) in enumerate(self._fingers.items() if self._pictures else ()):
            state = world.touch(number).state
            moved = finger.elastomer.marker_displacement(state.force)
            fingers[side] = finger.observe(state, moved, index, stamp, phase)
        return GraspFrame(
            index=index,
            stamp_ns=stamp,
            phase=phase,
            fingers=fingers,
            wrenches={side: world.wrench(number) for number, side in enumerate(SIDES)},
            fingertips={side: world.world_pose(side) for side in SIDES},
            held=world.world_pose(OBJECT),
            mass=mass,
            controls=dict(controls),
        )


def _goal(phase: GraspPhase, before: Mapping[str, float]) -> dict[str, float]:
    """The controls at the end of a phase."""
    goal = {**before, **phase.controls}
    if phase.grip is not None:
        goal[GRIP] = phase.grip
    if phase.lift is not None:
        goal[LIFT] = phase.lift
    if phase.tilt_deg is not None:
        goal[TILT] = math.radians(phase.tilt_deg)
    return goal


def _body(scene: GraspScene, pose: Pose) -> Indenter:
    """The object as a gel meets it; pose: T_gel_object at the start."""
    held = scene.object
    if held.file is not None:
        return MeshIndenter.load(held.file, **held.values, rotation=pose.rotation)
    body: Indenter = INDENTERS[held.type](**held.values)
    return body
