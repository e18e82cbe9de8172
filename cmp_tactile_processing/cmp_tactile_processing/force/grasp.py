"""How two fingers hold an object: grip, load, margin to slip and weight from both force fields.

All vectors are in one frame, into which the pose of each gel frame leads.  Forces are those of the
object on the gripper, as everywhere.  The errors of the two fingers are taken as independent, the
systematic ones too: each sensor is calibrated by itself.  If both gels are stiffer than described
by the same share, the true error of the grip force is sqrt(2) times the reported one, and that of
the load along the grip axis is less.  Poses and centres of pressure are taken as exact.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from enum import IntFlag
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.force.advice import UNUSABLE
from cmp_tactile_processing.measured import NAN, NS_PER_S, ForceField, SlipEstimate, SlipState

Array: TypeAlias = NDArray[np.float64]

# Fingers face each other up to this cosine of half the angle between one normal and the other's
# opposite: 60 degrees.
MIN_FACING = 0.5
# The weight is a mean over this time, of at least so many forces and over this share of the time.
WEIGHING_NS = NS_PER_S
MIN_WEIGHED = 5
MIN_WEIGHED_SHARE = 0.8
# The load is steady while its standard deviation stays below so many of its random error.
MAX_SCATTER_STD = 3.0
# A contact without slip has shown the ratio that it used less so many standard deviations.
SHOWN_BELOW_STD = 2.0
# The worst of two states stands last.
SLIP_ORDER = (
    SlipState.STICK,
    SlipState.NO_CONTACT,
    SlipState.UNKNOWN,
    SlipState.INCIPIENT,
    SlipState.FULL,
)


class GraspFlag(IntFlag):
    """What a user must know about a GraspState, beside the ForceFlags of both fingers."""

    NONE = 0
    STALE = 1 << 16  # a finger gives no force, or none at the time of the other's: all is NaN
    NO_TRANSFORM = 1 << 17  # the pose of a finger is not known: all is NaN
    NOT_FACING = 1 << 18  # the fingers do not face each other as described: all is NaN
    NO_CONTACT = 1 << 19  # a finger touches nothing: no torque, margin and weight
    FRICTION_UNKNOWN = 1 << 20  # nothing has slid and no friction is given: no margin
    NO_UP = 1 << 21  # it is not known what is up: no weight


ALL_NAN = GraspFlag.STALE | GraspFlag.NO_TRANSFORM | GraspFlag.NOT_FACING


def _unknown(*shape: int) -> Array:
    return np.full(shape, NAN)


@dataclass(frozen=True)
class GraspState:
    """How an object is held; N, N m and m, NaN where not known.

    grip_axis (3,): unit vector from the left finger to the right one.  grip_force: with which both
    press, half the difference of their forces along that axis.  normal_force (2,): of each on its
    gel, positive for a press; left, right.
    load (6,): force of the object on the gripper, and its moment about centre_of_contact (3,), the
    mean of both centres of pressure weighted by the normal forces; load_covariance (6, 6).
    load_across (3,): the part of the force across the grip axis.  grip_torque: the moment about
    the grip axis.
    traction_ratio: friction that the finger closer to slip uses, with the torque about its normal.
    friction_coefficient, friction_std: what is available.  friction_shown: the largest ratio that
    a contact without slip has used, less two standard deviations; the friction is at least that.
    slip_margin: share of the friction that is not used, 1 for none; negative beyond the limit.
    slip_state, slip_ratio: the worse of both fingers.
    supported_weight: force against gravity that the fingers carry, while it is steady.
    flags: of ForceFlag, of both fingers, and of GraspFlag.
    """

    grip_axis: Array = field(default_factory=lambda: _unknown(3))
    grip_force: float = NAN
    grip_force_std: float = NAN
    normal_force: Array = field(default_factory=lambda: _unknown(2))
    load: Array = field(default_factory=lambda: _unknown(6))
    load_covariance: Array = field(default_factory=lambda: _unknown(6, 6))
    load_across: Array = field(default_factory=lambda: _unknown(3))
    grip_torque: float = NAN
    grip_torque_std: float = NAN
    centre_of_contact: Array = field(default_factory=lambda: _unknown(3))
    slip_state: SlipState = SlipState.UNKNOWN
    slip_ratio: float = NAN
    traction_ratio: float = NAN
    friction_coefficient: float = NAN
    friction_std: float = NAN
    friction_shown: float = NAN
    slip_margin: float = NAN
    slip_margin_std: float = NAN
    supported_weight: float = NAN
    supported_weight_std: float = NAN
    flags: int = 0

    @property
    def usable(self) -> bool:
        """Whether a controller may use the forces."""
        return not self.flags & (UNUSABLE | ALL_NAN)


@dataclass(frozen=True)
class Finger:
    """What one finger feels; pose (4, 4) takes points of its gel frame into the common frame."""

    field: ForceField
    pose: Array

    def wrench_about(self, point: Array) -> tuple[Array, Array]:
        """The wrench (6,) in the common frame, moment about a point (3,), and its covariance."""
        J = wrench_transform(self.pose, self.field.reference_point, point)
        return J @ self.field.wrench, J @ self.field.wrench_covariance @ J.T

    @property
    def normal(self) -> Array:
        """Unit vector (3,) out of the gel."""
        return self.pose[:3, 2]


def wrench_transform(pose: Array, reference_point: Array, point: Array) -> Array:
    """J (6, 6): from a wrench of one frame to the same in another, about another point.

    pose (4, 4): from the first frame to the other.  reference_point (3,): that moments refer to, in
    the first frame; point (3,): in the other.
    """
    R = pose[:3, :3]
    arm = R @ reference_point + pose[:3, 3] - point
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = R
    J[3:, :3] = np.cross(arm, R, axisb=0, axisc=0)
    return J


def torsion_radius(field: ForceField) -> float:
    """Mean distance of the pressure from its centre, m; NaN without pressure.

    Torque about the normal over normal force and friction of a contact that turns on the spot.
    """
    points = field.position[field.contact, :2]
    pressure = np.maximum(0.0, -field.force[field.contact, 2])
    total = pressure.sum()
    if total <= 0:
        return NAN
    centre = pressure @ points / total
    return float(pressure @ np.linalg.norm(points - centre, axis=1) / total)


def friction_use(field: ForceField) -> tuple[float, float]:
    """Friction that a contact uses, over its normal force, and its variance; NaN without contact.

    A contact that carries a torque M about its normal has less friction for a tangential force T.
    Both are weighed by the ellipsoid that approximates the limit surface of a patch,
    (T / mu N)^2 + (M / mu N r)^2 <= 1, with r of `torsion_radius` (Goyal, Ruina and Papadopoulos,
    Wear 143, 1991; Howe and Cutkosky, International Journal of Robotics Research 15, 1996).
    """
    x, y, _ = field.centre_of_pressure - field.reference_point
    force, normal = field.wrench[:2], -field.wrench[2]
    if not normal > 0:
        return NAN, NAN
    radius = torsion_radius(field)
    share = 1 / radius if radius > 0 else 0.0
    torsion = share * (field.wrench[5] - (x * force[1] - y * force[0]))
    used = math.hypot(*force, torsion)
    # The gradient of `used` by fx, fy and mz, then of used / normal by the wrench.
    unit = np.array([*force, torsion]) / max(used, np.finfo(float).tiny)
    by_wrench = np.zeros(6)
    by_wrench[[0, 1]] = unit[:2] + unit[2] * share * np.array([y, -x])
    by_wrench[2] = used / normal
    by_wrench[5] = unit[2] * share
    by_wrench /= normal
    return used / normal, float(by_wrench @ field.wrench_covariance @ by_wrench)


class KnownFriction:
    """What a grasp has shown of its friction since it began."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Another object may come."""
        self._measured = self._std = self.shown = NAN

    def update(self, slips: list[SlipEstimate], uses: list[tuple[float, float]]) -> None:
        """Take both fingers into account: the less rough one, where both slide."""
        sliding = [slip for slip in slips if slip.friction_coefficient > 0]
        if sliding:
            least = min(sliding, key=lambda slip: slip.friction_coefficient)
            self._measured, self._std = least.friction_coefficient, least.friction_std
        for slip, (ratio, variance) in zip(slips, uses, strict=True):
            if slip.state is SlipState.STICK:
                shown = max(0.0, ratio - SHOWN_BELOW_STD * _root(variance))
                self.shown = float(np.fmax(self.shown, shown))

    def available(self, given: float) -> tuple[float, float]:
        """Coefficient and standard deviation; given: where none was measured, 0 for unknown.

        A contact that has used more without slip has more than what is given.
        """
        if self._measured > 0:
            return self._measured, self._std
        return (float(np.fmax(given, self.shown)), 0.0) if given > 0 else (NAN, NAN)


class SteadyWeight:
    """Mean of the load against gravity over the last second, while it is steady."""

    def __init__(self) -> None:
        self._loads: deque[tuple[int, float, float, float]] = deque()

    def forget(self) -> None:
        """Begin again."""
        self._loads.clear()

    def update(
        self, stamp_ns: int, load: float, variance: float, random: float
    ) -> tuple[float, float]:
        """Mean and standard deviation; NaN while the load changes, and for too few forces.

        variance: of one load, of which `random` is not systematic.  A mean is not taken as more
        exact than one force: errors of the resolution do not change from frame to frame.
        """
        loads = self._loads
        if not math.isfinite(load) or (loads and stamp_ns <= loads[-1][0]):
            loads.clear()
        if not math.isfinite(load):
            return NAN, NAN
        loads.append((stamp_ns, load, variance, random))
        while stamp_ns - loads[0][0] > WEIGHING_NS:
            loads.popleft()
        span = stamp_ns - loads[0][0]
        if len(loads) < MIN_WEIGHED or span < MIN_WEIGHED_SHARE * WEIGHING_NS:
            return NAN, NAN
        _, values, variances, randoms = np.array(loads).T
        if not values.std() <= MAX_SCATTER_STD * _root(randoms.mean()):
            return NAN, NAN
        return float(values.mean()), _root(variances.mean())


class GraspEstimator:
    """Computes the GraspState of each pair of force fields; remembers friction and last loads."""

    def __init__(self) -> None:
        self._friction, self._weight = KnownFriction(), SteadyWeight()

    def forget(self) -> None:
        """Forget the object."""
        self._friction.forget()
        self._weight.forget()

    def update(
        self, left: Finger, right: Finger, stamp_ns: int, up: Array | None, friction: float = 0.0
    ) -> GraspState:
        """The state at a stamp.

        up: unit vector (3,) against gravity, None if unknown.  friction: of gel and object, used
        until slip shows it; 0 if unknown.
        """
        fingers = left, right
        flags = int(left.field.flags | right.field.flags)
        axis = (left.normal - right.normal) / 2
        facing = float(np.linalg.norm(axis))
        if not facing > MIN_FACING:
            self.forget()
            return GraspState(flags=flags | GraspFlag.NOT_FACING)
        state = replace(_held(left, right, axis / facing), flags=flags)
        if (state.normal_force <= 0).any():
            self.forget()
            return replace(state, flags=flags | GraspFlag.NO_CONTACT)
        return self._weighed(self._with_margin(state, fingers, friction), fingers, stamp_ns, up)

    def _with_margin(
        self, state: GraspState, fingers: tuple[Finger, Finger], given: float
    ) -> GraspState:
        uses = [friction_use(finger.field) for finger in fingers]
        self._friction.update([finger.field.slip for finger in fingers], uses)
        available, std = self._friction.available(given)
        # NaN counts as the larger one.
        ratio, variance = uses[int(np.argmax([use[0] for use in uses]))]
        share = ratio / available
        return replace(
            state,
            traction_ratio=ratio,
            friction_coefficient=available,
            friction_std=std,
            friction_shown=self._friction.shown,
            slip_margin=1 - share,
            slip_margin_std=math.hypot(_root(variance), share * std) / available,
            flags=state.flags | (0 if available > 0 else GraspFlag.FRICTION_UNKNOWN),
        )

    def _weighed(
        self, state: GraspState, fingers: tuple[Finger, Finger], stamp_ns: int, up: Array | None
    ) -> GraspState:
        if up is None:
            self._weight.forget()
            return replace(state, flags=state.flags | GraspFlag.NO_UP)
        systematic = 0.0
        for finger in fingers:
            up_gel = up @ finger.pose[:3, :3]
            covariance = np.nan_to_num(finger.field.systematic_covariance[:3, :3])
            systematic += float(up_gel @ covariance @ up_gel)
        variance = float(up @ state.load_covariance[:3, :3] @ up)
        load = -float(up @ state.load[:3])
        weight, std = self._weight.update(stamp_ns, load, variance, variance - systematic)
        return replace(state, supported_weight=weight, supported_weight_std=std)


def _held(left: Finger, right: Finger, axis: Array) -> GraspState:
    """Forces, moments and slip of both fingers together."""
    fingers = left, right
    normal_force = 0.0 - np.array([finger.field.wrench[2] for finger in fingers])
    centre = _centre_of_contact(fingers, normal_force)
    # Without a centre the moments are NaN, not the forces.
    (on_left, left_covariance), (on_right, right_covariance) = (
        finger.wrench_about(centre) for finger in fingers
    )
    load, covariance = on_left + on_right, left_covariance + right_covariance
    return GraspState(
        grip_axis=axis,
        grip_force=float((on_right - on_left)[:3] @ axis) / 2,
        grip_force_std=_root(axis @ covariance[:3, :3] @ axis) / 2,
        normal_force=normal_force,
        load=load,
        load_covariance=covariance,
        load_across=load[:3] - (load[:3] @ axis) * axis,
        grip_torque=float(load[3:] @ axis),
        grip_torque_std=_root(axis @ covariance[3:, 3:] @ axis),
        centre_of_contact=centre,
        slip_state=max((f.field.slip.state for f in fingers), key=SLIP_ORDER.index),
        slip_ratio=float(np.fmax(left.field.slip.slip_ratio, right.field.slip.slip_ratio)),
    )


def _root(variance: Any) -> float:
    """Its root; rounding may make a variance less than 0."""
    return float(np.sqrt(np.maximum(variance, 0.0)))


def _centre_of_contact(fingers: tuple[Finger, Finger], normal_force: Array) -> Array:
    """Mean of the centres of pressure (3,) by normal force; NaN where no finger touches."""
    places = np.array(
        [f.pose[:3, :3] @ f.field.centre_of_pressure + f.pose[:3, 3] for f in fingers]
    )
    weights = np.where(np.isfinite(places).all(axis=1), np.maximum(0.0, normal_force), 0.0)
    if not weights.sum() > 0:
        return _unknown(3)
    return np.asarray(weights @ np.nan_to_num(places) / weights.sum())
