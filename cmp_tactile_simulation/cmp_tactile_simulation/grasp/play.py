"""Plays a grasp: moves the gripper, and gives frames of both fingertips with their truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ContactError, InputError
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


@dataclass(frozen=True)
class Asked:
    """What is asked of gripper and object at one time step.

    number: of the phase.  controls: of actuators, by name.  push (6,) N and N m: on the object.
    mass kg: of the object.
    """

    number: int
    phase: GraspPhase
    controls: dict[str, float] = field(default_factory=dict)
    push: Array = field(default_factory=lambda: np.zeros(6))
    mass: float = 0.0


def motion_of(
    scene: GraspScene, world: World, lasts: Callable[[int], bool] = lambda _: False
) -> Iterator[Asked]:
    """What a scene asks, for each time step of a world at its beginning.

    lasts: whether the phase of a number goes on as it is where its duration is over.
    """
    before, step = Asked(0, scene.motion[0], mass=scene.mass), world.model.opt.timestep
    for which, phase in enumerate(scene.motion):
        goal = _goal(phase, before.controls)
        begin = {name: before.controls.get(name, world.control(name)) for name in goal}
        heavier = before.mass if phase.mass is None else phase.mass
        push = np.array([*phase.force, *phase.torque])
        steps = max(1, round(phase.duration / step))
        for number in count(1):
            share = min(1.0, number / steps)
            smooth = share * share * (3 - 2 * share)
            controls = {
                name: (1 - smooth) * begin[name] + smooth * value for name, value in goal.items()
            }
            if phase.shake:
                angle = 2 * math.pi * phase.shake_hz * number * step
                controls[SHAKE] = controls.get(SHAKE, 0.0) + phase.shake * math.sin(angle)
            now_push = (1 - smooth) * before.push + smooth * push
            mass = before.mass + (heavier - before.mass) * share
            yield Asked(which, phase, controls, now_push, mass)
            if number >= steps and not lasts(which):
                break
        before = Asked(which, phase, controls, push, heavier)


class Grasp:
    """A grasp: the rigid world, and a simulator of each finger by side.

    pictures: whether cameras see it; without, `fingers` of its frames are empty.
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
        _check_actuators(scene, self.world)
        self._pictures = pictures
        self.fingers = {
            side: Simulator(
                scene.described[side],
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
        self.world.hold([finger.contact for finger in self.fingers.values()])

    def restart(self) -> None:
        """Everything as at the beginning, the gels never touched."""
        self.world.reset()
        for finger in self.fingers.values():
            finger.reset()
        self.world.hold([finger.contact for finger in self.fingers.values()])

    def frames(self) -> Iterator[GraspFrame]:
        """The frames, in order; ContactError with the time where a gel cannot follow."""
        scene, world = self.scene, self.world
        step = world.model.opt.timestep
        period, index = 1 / scene.rate, 0
        now, phase = 0.0, ""
        try:
            for number, asked in enumerate(motion_of(scene, world)):
                now, phase = number * step, asked.phase.name
                if now >= index * period - step / 2:
                    # The picture shows the gel as it is at this moment.
                    world.solve(always=True)
                    yield self._frame(index, asked)
                    index += 1
                world.step(asked.controls, asked.push, asked.mass)
        except ContactError as error:
            msg = f"{scene.name}: {now:.2f} s, {phase}: {error}"
            raise ContactError(msg) from None

    def _frame(self, index: int, asked: Asked) -> GraspFrame:
        world, phase = self.world, asked.phase.name
        stamp = FIRST_STAMP_NS + round(index * NS_PER_S / self.scene.rate)
        fingers = {}
        for number, (side, finger) in enumerate(self.fingers.items() if self._pictures else ()):
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
            mass=asked.mass,
            controls=asked.controls,
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
    if SHAKE in before:
        # What is left of a shake.
        goal[SHAKE] = 0.0
    return goal


def _check_actuators(scene: GraspScene, world: World) -> None:
    """Raise InputError for a phase, or a servo, that sets what the gripper does not have."""
    known = ", ".join(world.actuators) or "none"
    strange = sorted({*(scene.servo.open if scene.servo else ())} - {*world.actuators})
    if strange:
        msg = f"{scene.file}: servo.open: found the actuator {strange[0]}, expected one of {known}"
        raise InputError(msg)
    for number, phase in enumerate(scene.motion):
        names = {*_goal(phase, {}), *([SHAKE] if phase.shake else [])}
        if GRIP in names:
            names = names - {GRIP} | {f"{GRIP}_{side}" for side in SIDES}
        missing = sorted(names - {*world.actuators})
        if missing:
            msg = f"{scene.file}: motion[{number}], {phase.name}: found the actuator {missing[0]}"
            msg += f", expected one of the gripper's: {known}"
            raise InputError(msg)


def _body(scene: GraspScene, pose: Pose) -> Indenter:
    """The object as a gel meets it; pose: T_gel_object at the start."""
    held = scene.object
    if held.file is not None:
        return MeshIndenter.load(held.file, **held.values, rotation=pose.rotation)
    body: Indenter = INDENTERS[held.type](**held.values)
    return body
