"""A grasp in real time: a scene's motion, and fingers that the scene or a controller moves."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.processes import OnProgress, no_progress
from cmp_tactile_processing.sensor.parameters import Parameters, parameter
from cmp_tactile_simulation.contact.laws import Pose
from cmp_tactile_simulation.grasp.play import Asked, Grasp, motion_of
from cmp_tactile_simulation.grasp.scene import SIDES, GraspScene, Servo
from cmp_tactile_simulation.grasp.world import GRIP, OBJECT, OPENING, World
from cmp_tactile_simulation.live.mechanics import REST_PICTURES
from cmp_tactile_simulation.live.sensor import with_half_the_pixels
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.simulator import Look, SensorCamera

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

DRIVES = SCENE, COMMAND = "scene", "command"
# An object is held where a controller presses with this share of the scene's grip for so long, s.
HELD_SHARE, HELD_S = 0.5, 1.0
# Places of a servo, from open to closed, at which the opening is measured.
SERVO_SHARES = np.linspace(0.0, 1.0, 33)
# Least difference between open and closed, m.
LEAST_TRAVEL = 1e-3


@dataclass(frozen=True)
class LiveGraspSettings(Parameters):
    """How a grasp is simulated live."""

    drive: str = parameter(
        SCENE,
        "what moves the fingers: the scene, or gripper/command; then the motion goes on "
        "when the object is held",
        choices=DRIVES,
    )
    loop: bool = parameter(True, "play the scene's motion again and again")
    rate: float = parameter(
        0.0, "frames per second of each sensor; 0: those of the scene", unit="Hz", within=(0, 60)
    )
    contact_nodes: int = parameter(
        16, "number of contact nodes along each side, unless the scene has fewer", within=(8, 100)
    )


@dataclass(frozen=True)
class GraspMoment:
    """What is true at one moment, by side.

    surfaces: of the gels.  wrenches (6,) N and N m: on the gels, gel frames.  fingertips: gel
    frames, and held: the object, in the world.
    """

    number: int
    surfaces: Mapping[str, DeformedSurface]
    wrenches: Mapping[str, Array]
    fingertips: Mapping[str, Pose]
    held: Pose


class LiveGrasp:
    """Advances a grasp in steps of time, and takes pictures of it.

    Its motion begins when the sensors had time to take their references: somebody took the pictures
    of so many moments.  Frames are those of a recorded grasp, with what there is time for: a linear
    gel, one sample of a pixel, the rays of 2 x 2 pixels found together.

    command: opening that a controller asks for, m; None as long as it has asked for none.
    controls: of actuators, by name, which take precedence over those of the scene.  A restart
    forgets both.
    taken: number of moments whose pictures somebody took.
    phase: what the scene does now.
    """

    def __init__(
        self, scene: GraspScene, settings: LiveGraspSettings, progress: OnProgress = no_progress
    ) -> None:
        """Raises what `Grasp` raises."""
        tips = {
            side: replace(tip, elastomer=replace(tip.elastomer, model="linear"))
            for side, tip in scene.described.items()
        }
        nodes = min(scene.contact_nodes, settings.contact_nodes)
        self._scene = replace(scene, described=tips, contact_nodes=nodes)
        self._settings = settings
        self._grasp = Grasp(self._scene, progress=progress)
        self._cameras = {
            side: SensorCamera(
                tip, Look(camera=scene.camera, samples=1, seed=number), with_half_the_pixels(tip)
            )
            for number, (side, tip) in enumerate(tips.items())
        }
        self._gripping, self._letting_go = _closing_and_opening(scene)
        self._openings = np.zeros(0)
        if settings.drive == COMMAND and scene.servo is not None:
            self._openings = _servo_openings(scene, scene.servo, self._grasp.world)
        self._step_s = float(self._grasp.world.model.opt.timestep)
        self._moments = self.taken = 0
        self._asked_s, self._steps = 0.0, 0
        self._begin()

    def restart(self) -> None:
        """Begin again: the object on the table, the gripper open."""
        self._grasp.restart()
        self._begin()

    def _begin(self) -> None:
        self._held_s = 0.0
        self.command: float | None = None
        self.controls: Mapping[str, float] = {}
        self._asked = Asked(0, self._scene.motion[0], mass=self._scene.mass)
        self._motion: Iterator[Asked] = motion_of(self._scene, self._grasp.world, self._lasts)

    @property
    def phase(self) -> str:
        """Name of the phase of the motion; of what is waited for before it."""
        return "taking references" if self.taken < REST_PICTURES else self._asked.phase.name

    @property
    def actuators(self) -> Collection[str]:
        """Names of the model's actuators."""
        return self._grasp.world.actuators

    @property
    def opening(self) -> float:
        """Between the fingertips, m."""
        return self._grasp.world.opening

    @property
    def grips(self) -> list[float]:
        """With which each finger presses, N."""
        return [-float(wrench[2]) for wrench in self.wrenches().values()]

    def advance(self, duration: float) -> None:
        """Let time pass, s.

        Raises ContactError where a gel cannot follow, and InputError for an unknown actuator; it
        has to be started again then.
        """
        world = self._grasp.world
        # A duration may have a part of a step.
        self._asked_s += duration
        steps = round(self._asked_s / self._step_s)
        begin, self._steps = self._steps, steps
        for _ in range(begin, steps):
            if self.taken >= REST_PICTURES:
                found = next(self._motion, None)
                if found is None and self._settings.loop:
                    self.restart()
                self._asked = found or self._asked
            world.step(self._controls(), self._asked.push, self._asked.mass)

    def _controls(self) -> dict[str, float]:
        asked = dict(self._asked.controls)
        if self._settings.drive == COMMAND:
            # At the end of a scene the hand opens, whatever a controller asks for.
            if self._scene.servo is not None:
                asked |= self._servo_controls(self._scene.servo, asked)
            elif self._scene.model is None and asked.get(GRIP, 0.0) >= 0:
                asked.pop(GRIP, None)
                opening = self._scene.gripper.opening
                asked[OPENING] = opening if self.command is None else self.command
        return {**asked, **self.controls}

    def _servo_controls(self, servo: Servo, asked: Mapping[str, float]) -> dict[str, float]:
        share = 0.0
        if self.command is not None:
            share = float(np.interp(-self.command, -self._openings, SERVO_SHARES))
        if self._asked.number in self._letting_go:
            share = min(share, servo.share(asked))
        return servo.controls(share)

    def _lasts(self, number: int) -> bool:
        """Whether the object is not held yet, where a controller is to grip it."""
        if self._settings.drive == SCENE or number != self._gripping:
            return False
        servo, grip = self._scene.servo, self._scene.motion[number].grip
        held = HELD_SHARE * (grip or 0.0) if servo is None else servo.held
        pressed = min(self.grips) > held
        self._held_s = self._held_s + self._step_s if pressed else 0.0
        return self._held_s < HELD_S

    def wrenches(self) -> dict[str, Array]:
        """True wrenches on the gels now, (6,) N and N m by side, gel frames."""
        return {side: self._grasp.world.wrench(number) for number, side in enumerate(SIDES)}

    def moment(self) -> GraspMoment:
        """What is true now; ContactError where a gel cannot follow."""
        world = self._grasp.world
        world.solve(always=True)
        surfaces = {}
        for number, (side, finger) in enumerate(self._grasp.fingers.items()):
            moved = finger.elastomer.marker_displacement(world.touch(number).state.force)
            pattern, observers = finger.sensor.pattern, finger.elastomer.observers
            surfaces[side] = DeformedSurface(pattern, observers, moved)
        self._moments += 1
        return GraspMoment(
            number=self._moments,
            surfaces=surfaces,
            wrenches=self.wrenches(),
            fingertips={side: world.world_pose(side) for side in SIDES},
            held=world.world_pose(OBJECT),
        )

    def pictures(self, moment: GraspMoment) -> dict[str, Image]:
        """The camera frames of a moment, (H, W) by side; for one other thread."""
        return {
            side: camera.picture(moment.number, moment.surfaces[side])
            for side, camera in self._cameras.items()
        }


def _closing_and_opening(scene: GraspScene) -> tuple[int | None, set[int]]:
    """Number of the phase that grips, None without one, and of those in which a servo lets go.

    The first that asks for a grip; of a servo, the first that closes it most.  Later, the servo
    lets go while the scene has it open by more than half.
    """
    servo = scene.servo
    if servo is None:
        grips = (n for n, phase in enumerate(scene.motion) if (phase.grip or 0.0) > 0)
        return next(grips, None), set()
    shares = [0.0]
    for phase in scene.motion:
        share = servo.share(phase.controls)
        shares.append(shares[-1] if math.isnan(share) else share)
    gripping = int(np.argmax(shares)) - 1
    if gripping < 0:
        return None, set()
    later = range(gripping + 1, len(scene.motion))
    return gripping, {n for n in later if shares[n + 1] < shares[gripping + 1] / 2}


def _servo_openings(scene: GraspScene, servo: Servo, world: World) -> Array:
    """Openings (n,) m at SERVO_SHARES, falling.

    Raises InputError for a servo that does not close the fingers.
    """
    found = world.openings([servo.controls(share) for share in SERVO_SHARES])
    if not found[0] - found[-1] > LEAST_TRAVEL:
        msg = f"{scene.file}: servo: found openings of {1e3 * found[0]:.1f} mm where open and "
        msg += f"{1e3 * found[-1]:.1f} mm where closed, expected more than "
        msg += f"{1e3 * LEAST_TRAVEL:g} mm less where closed"
        raise InputError(msg)
    return np.minimum.accumulate(found)
