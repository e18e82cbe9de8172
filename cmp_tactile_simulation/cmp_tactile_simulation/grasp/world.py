"""The rigid world of a grasp in MuJoCo: a gripper, an object, and the gels between them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.files import packaged_files
from cmp_tactile_processing.cache.threads import one_thread
from cmp_tactile_processing.errors import ContactError, InputError
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import Pose
from cmp_tactile_simulation.grasp.coupling import (
    FingerContact,
    FingerTouch,
    push,
    relative_velocity,
    seen_from,
    shifted,
)
from cmp_tactile_simulation.grasp.scene import SIDES, GraspScene

Array = NDArray[np.float64]

PACKAGE = "cmp_tactile_simulation"
INSTALL = "found no MuJoCo: pip install mujoco"
# Longer steps let a light object on two gels swing more and more, s.
MAX_STEP_S = 5e-4
# Fingers are at rest if they move less than STILL_M in SETTLE_S; they have LONGEST_S for it.
STILL_M = 1e-6
SETTLE_S = 0.1
LONGEST_S = 3.0
# Names in the packaged gripper, of its actuators (a grip is one of each finger) and of what it
# holds.
LIFT, SHAKE, TILT, GRIP, OBJECT = "lift", "shake", "tilt", "grip", "object"
# What a controller asks of the packaged gripper instead of a grip: the opening, m, reached with
# this time constant, s.
OPENING, OPENING_S = "opening", 0.01


def load_mujoco() -> Any:
    """The module; InputError with the line that installs it."""
    try:
        import mujoco
    except ImportError as error:
        raise InputError(INSTALL) from error
    # Otherwise it writes its warnings into a file in the working folder.
    mujoco.set_mju_user_warning(lambda _: None)
    return mujoco


def gripper_model(scene: GraspScene) -> Any:
    """The MuJoCo model (MjSpec) of the packaged gripper, or of the scene's own, with the object.

    World of the packaged one: x across the fingers, y along which they close, z up.
    Raises InputError for a file that MuJoCo refuses, and for a fingertip on an unknown body.
    """
    mujoco = load_mujoco()
    packaged = packaged_files(PACKAGE, "grasps/*.xml")["gripper"]
    path = packaged if scene.model is None else scene.file.parent / scene.model
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        msg = f"{path}: MuJoCo refuses it: {error}"
        raise InputError(msg) from None
    spec.option.timestep = min(spec.option.timestep, MAX_STEP_S)
    if scene.model is None:
        spec.body("hand").pos[2] = scene.gripper.height
        for side in SIDES:
            place = spec.site(side).pos
            place[1] = math.copysign(scene.gripper.opening / 2, place[1])
            # Fingers with nothing between them stop at each other.
            spec.joint(side).range[1] = scene.gripper.opening / 2
    for side, tip in scene.fingertips.items():
        finger = spec.body(tip.body)
        if finger is None:
            names = ", ".join(body.name for body in spec.bodies[1:])
            msg = f"{path}: found the bodies {names}, expected {tip.body} of the {side} fingertip"
            raise InputError(msg)
        site = finger.add_site(name=side, pos=tip.pos)
        site.alt.type, site.alt.xyaxes = mujoco.mjtOrientation.mjORIENTATION_XYAXES, tip.xyaxes
    if spec.body(OBJECT) is None:
        held = spec.worldbody.add_body(name=OBJECT, pos=scene.position)
        held.add_freejoint()
        _add_shape(mujoco, spec, held, scene)
    return spec


def _add_shape(mujoco: Any, spec: Any, body: Any, scene: GraspScene) -> None:
    kind, values = scene.object.type, scene.object.values
    geometry = mujoco.mjtGeom
    if scene.object.file is not None:
        scale = [values.get("scale") or 1.0] * 3
        spec.add_mesh(name=OBJECT, file=str(scene.object.file.resolve()), scale=scale)
        body.add_geom(type=geometry.mjGEOM_MESH, meshname=OBJECT, mass=scene.mass)
    elif kind == "cuboid":
        half = [side / 2 for side in values["size"]]
        body.add_geom(type=geometry.mjGEOM_BOX, size=half, mass=scene.mass)
    elif kind == "sphere":
        size = [values["radius"], 0, 0]
        body.add_geom(type=geometry.mjGEOM_SPHERE, size=size, mass=scene.mass)
    else:
        size = [values["radius"], values["length"] / 2, 0]
        # Our cylinder lies about x, MuJoCo's stands about z.
        quat = [np.sqrt(0.5), 0, np.sqrt(0.5), 0]
        body.add_geom(type=geometry.mjGEOM_CYLINDER, size=size, quat=quat, mass=scene.mass)


class World:
    """Steps a MuJoCo model in which gels hold an object.

    sites: names of the gel frames.  contacts: of each gel with the object.
    speed: m/s, of each finger of the packaged gripper.
    """

    def __init__(
        self, spec: Any, sites: Sequence[str], held: str, speed: float, keyframe: str | None = None
    ) -> None:
        """keyframe: of the model, to begin at.

        Raises InputError for a model that MuJoCo refuses, or without a site, the body or the
        keyframe.
        """
        self._mujoco = load_mujoco()
        try:
            self.model = spec.compile()
        except ValueError as error:
            msg = f"model: MuJoCo refuses it: {error}"
            raise InputError(msg) from None
        self.data = self._mujoco.MjData(self.model)
        self._keyframe = None if keyframe is None else self._number("key", keyframe)
        self._names, self._speed = list(sites), speed
        self._sites = [self._number("site", name) for name in sites]
        self._held = self._number("body", held)
        self._fingers = [int(self.model.site_bodyid[site]) for site in self._sites]
        self._actuators = {self.model.actuator(n).name: n for n in range(self.model.nu)}
        self._limits = self.model.actuator_forcerange.copy()
        data = self.data
        # Views of what a step changes: place and rotation of each gel, and of the object.
        self._frames = [(data.site_xpos[n], data.site_xmat[n].reshape(3, 3)) for n in self._sites]
        self._at = data.xpos[self._held], data.xmat[self._held].reshape(3, 3)
        self._applied, self._centres = data.xfrc_applied, data.xipos
        self._speeds = np.zeros(6), np.zeros(6)
        self._masses = self.model.body_mass.copy(), self.model.body_inertia.copy()
        self._gels: list[FingerContact] = []
        self.reset()

    def _number(self, kind: str, name: str) -> int:
        finder = getattr(self.model, kind)
        try:
            return int(finder(name).id)
        except KeyError:
            count = getattr(self.model, f"n{kind}")
            names = ", ".join(finder(n).name for n in range(count)) or "none"
            msg = f"model: found the {kind} names {names}, expected {name}"
            raise InputError(msg) from None

    def reset(self) -> None:
        """Everything where it was at the beginning; gels have to be held again."""
        self._begin(self.data)
        self.model.body_mass[:], self.model.body_inertia[:] = self._masses
        self.model.actuator_forcerange[:] = self._limits
        self._mujoco.mj_forward(self.model, self.data)

    def _begin(self, data: Any) -> None:
        self._mujoco.mj_resetData(self.model, data)
        if self._keyframe is not None:
            self._mujoco.mj_resetDataKeyframe(self.model, data, self._keyframe)

    @property
    def actuators(self) -> Collection[str]:
        """Names of the model's actuators."""
        return self._actuators.keys()

    def control(self, name: str) -> float:
        """What the actuator of a name is set to, 0 for the grip of both fingers."""
        return 0.0 if name == GRIP else float(self.data.ctrl[self._actuator(name)])

    def hold(self, contacts: Sequence[ContactSimulation]) -> None:
        """Let these gels act between the fingertips and the object from now on.

        Raises ContactError where the object is inside a gel.
        """
        self._gels = [self._held_by(finger, contact) for finger, contact in enumerate(contacts)]
        self._poses = [self.pose(finger) for finger in range(len(contacts))]
        # The object and the fingers' other parts meet in the gels alone.
        for body in self._fingers:
            geoms = np.flatnonzero(self.model.geom_bodyid == body)
            self.model.geom_contype[geoms] = self.model.geom_conaffinity[geoms] = 0

    def _held_by(self, finger: int, contact: ContactSimulation) -> FingerContact:
        try:
            return FingerContact(contact, self.pose(finger))
        except ContactError as error:
            msg = f"{self._names[finger]} fingertip: {error}"
            raise ContactError(msg) from None

    def pose(self, finger: int) -> Pose:
        """T_gel_object of a finger's gel."""
        return Pose(*seen_from(*self._frames[finger], *self._at))

    def world_pose(self, name: str) -> Pose:
        """Of a site, or of the body that is held where there is no such site."""
        known = name in self._names
        place, turn = self._frames[self._names.index(name)] if known else self._at
        return Pose(place.copy(), turn.copy())

    @property
    def opening(self) -> float:
        """From the first gel to the second, along the first one's normal, m."""
        return self._opening_in(self.data)

    def _opening_in(self, data: Any) -> float:
        first, second = self._sites
        way = data.site_xpos[second] - data.site_xpos[first]
        return float(way @ data.site_xmat[first].reshape(3, 3)[:, 2])

    def openings(self, controls: Sequence[Mapping[str, float]]) -> Array:
        """The opening (n,) m at rest for these n controls, one after the other, without contacts.

        In a world of its own, which begins as this one does.  Raises ContactError where it has no
        solution.
        """
        mujoco, model = self._mujoco, self.model
        data, flags = mujoco.MjData(model), model.opt.disableflags
        self._begin(data)
        found, steps = [math.inf], round(SETTLE_S / model.opt.timestep)
        model.opt.disableflags = flags | int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        try:
            for item in controls:
                for name, value in item.items():
                    data.ctrl[self._actuator(name)] = value
                before = found[-1]
                for _ in range(round(LONGEST_S / SETTLE_S)):
                    mujoco.mj_step(model, data, steps)
                    opening = self._opening_in(data)
                    if abs(opening - before) < STILL_M:
                        break
                    before = opening
                found.append(opening)
            self._check(data)
        finally:
            model.opt.disableflags = flags
        return np.array(found[1:])

    def touch(self, finger: int) -> FingerTouch:
        """The gel of a finger as it was last solved."""
        return self._gels[finger].touch

    def wrench(self, finger: int) -> Array:
        """On the gel now, (6,) N and N m about the gel frame's origin, gel frame."""
        pose = self.pose(finger)
        wrench = self._gels[finger].touch.ahead(pose, self._velocity(finger))
        return np.asarray(shifted(wrench, pose.position))

    def step(self, controls: Mapping[str, float], force: Array, mass: float) -> None:
        """One time step.

        controls: of actuators, by name; of both fingers of the packaged gripper: GRIP, N, or
        OPENING, m.
        force (6,) N and N m: on the object at its centre of mass, world frame.
        mass: of the object, kg.
        Raises ContactError where a gel cannot follow or the rigid world has no solution, and
        InputError for an unknown actuator.
        """
        data, model = self.data, self.model
        for name, value in controls.items():
            if name == GRIP:
                self._drive(math.copysign(self._speed, value), abs(value))
            elif name == OPENING:
                self._drive((self.opening - value) / 2 / OPENING_S)
            else:
                data.ctrl[self._actuator(name)] = value
        if mass != model.body_mass[self._held]:
            model.body_inertia[self._held] *= mass / model.body_mass[self._held]
            model.body_mass[self._held] = mass
        self._applied[:] = 0.0
        self._applied[self._held] = force
        for finger, gel in enumerate(self._gels):
            if not gel.touch.touches:
                continue
            wrench = gel.touch.ahead(self._poses[finger], self._velocity(finger))
            _, turn = self._frames[finger]
            for body, acting in ((self._fingers[finger], wrench), (self._held, -wrench)):
                push(acting, turn, self._at[0] - self._centres[body], self._applied[body])
        self._mujoco.mj_step(model, data)
        self._check(data)
        # Poses and velocities of the new place, without another step.
        self._mujoco.mj_kinematics(model, data)
        self._mujoco.mj_comPos(model, data)
        self._mujoco.mj_comVel(model, data)
        self.solve()

    def _check(self, data: Any) -> None:
        """Raise ContactError where there was no solution: MuJoCo has begun again by itself then."""
        warned = data.warning.number
        if warned.any():
            kind = int(warned.argmax())
            text = self._mujoco.mju_warningText(kind, int(data.warning.lastinfo[kind]))
            msg = f"MuJoCo: {text}"
            raise ContactError(msg)

    def solve(self, *, always: bool = False) -> None:
        """Solve the gels over which the object has moved noticeably, or all of them.

        Raises ContactError where a gel cannot follow.
        """
        for finger, gel in enumerate(self._gels):
            pose = self._poses[finger] = self.pose(finger)
            if (always and gel.touch.touches) or not gel.touch.holds_at(pose):
                with one_thread():
                    gel.move(pose)

    def _drive(self, speed: float, force: float | None = None) -> None:
        """Move the fingers together at this speed, m/s, their own at most, or apart.

        force: at most, N; None: what they have.
        """
        for side in SIDES:
            number = self._actuator(f"{GRIP}_{side}")
            most = self._limits[number] if force is None else (-force, force)
            self.model.actuator_forcerange[number] = most
            self.data.ctrl[number] = max(-self._speed, min(speed, self._speed))

    def _actuator(self, name: str) -> int:
        found = self._actuators.get(name)
        return self._number("actuator", name) if found is None else found

    def _velocity(self, finger: int) -> Array:
        """Of the object's origin relative to the gel, (6,) m/s and rad/s, gel frame."""
        (held, gel), kinds = self._speeds, self._mujoco.mjtObj
        find = self._mujoco.mj_objectVelocity
        find(self.model, self.data, kinds.mjOBJ_XBODY, self._held, held, 0)
        find(self.model, self.data, kinds.mjOBJ_SITE, self._sites[finger], gel, 0)
        place, turn = self._frames[finger]
        return np.asarray(relative_velocity(held, gel, self._at[0] - place, turn))
