"""What the gel of a fingertip and an object that moves in a rigid world do to each other.

The rigid world takes steps of half a millisecond; the gel is solved where the object has moved
noticeably over it.  In between its force follows its tangent stiffness (a quasi-static gel has no
other memory than its friction), and is damped a little, as gels are.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.errors import ContactError
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import ContactState, Pose, crossed

Array = NDArray[np.float64]

# The force also follows the rate of deformation by this time, s: a loss factor of 0.1 to 0.3 at the
# 30 to 90 Hz with which held objects of 50 to 300 g swing.
DAMPING_S = 5e-4
# The gel is solved again where its tangent changes the force by more than this share of the normal
# force, and by more than so much, N: it does not know that nodes begin to slide or to touch.
LARGEST_CHANGE, LEAST_CHANGE_N = 0.04, 0.04
# The normal force changes smoothly, and may change by more.
NORMAL_WEIGHT = 0.5
# It is solved after this way, m, also where a sliding object changes no force.
LONGEST_WAY_M = 5e-4
# A gel that is touched follows no farther at once, m: such a world has no solution.
FARTHEST_M = 2e-3
# How far a contact reaches about, m, to compare moments with forces.
ARM_M = 4e-3


@dataclass(frozen=True)
class FingerTouch:
    """A solved gel, and what its force is near there.

    wrench (6,): force N on the gel and moment N m about the object's origin, gel frame.
    stiffness (6, 6): its change by motions of the object, m and rad.
    middle (3,) m: of the contact, gel frame.  touches: whether the object touches the gel;
    clearance: m, how far it is away where it does not.
    """

    state: ContactState
    wrench: Array
    stiffness: Array
    middle: Array
    touches: bool
    clearance: float

    @cached_property
    def _tangent(self) -> tuple[Array, Array, Array, Array]:
        pose = self.state.pose
        return self.wrench, self.stiffness, pose.position, pose.rotation

    def ahead(self, pose: Pose, velocity: Array) -> Array:
        """The wrench (6,) on the gel with the object a little farther on, about its origin there.

        velocity (6,) m/s and rad/s: of the object relative to the gel, gel frame.
        """
        if not self.touches:
            return np.zeros(6)
        return np.asarray(_ahead(self._tangent, pose.position, pose.rotation, velocity))

    def holds_at(self, pose: Pose) -> bool:
        """Whether the tangent, or that nothing touches, still holds with the object there."""
        if self.touches:
            return bool(_is_near(self._tangent, self.middle, pose.position, pose.rotation))
        before = self.state.pose
        reach = math.dist(self.middle, before.position)
        moved = motion_between(before.position, before.rotation, pose.position, pose.rotation)
        return math.hypot(*moved[:3]) + reach * math.hypot(*moved[3:]) < self.clearance


class FingerContact:
    """The gel of one fingertip under an object that a rigid world moves."""

    def __init__(self, contact: ContactSimulation, pose: Pose) -> None:
        """pose: T_gel_object; ContactError where the object is inside the gel."""
        self.contact = contact
        self.touch = self._solved(contact.rest(pose))

    def move(self, pose: Pose) -> None:
        """Solve the gel with the object where it is now, T_gel_object.

        Raises ContactError where the contact leaves its patch or the gel cannot follow.
        """
        state = self.touch.state
        if not self.touch.touches:
            # What flies past does not have to be followed on its way.
            with suppress(ContactError):
                self.touch = self._solved(self.contact.rest(pose))
                return
        way = float(np.linalg.norm(pose.position - state.pose.position))
        if self.touch.touches and not way < FARTHEST_M:
            limit = f"expected less than {1e3 * FARTHEST_M:g} mm"
            msg = f"found a motion of {1e3 * way:.3g} mm since it was last solved, {limit}"
            raise ContactError(msg)
        self.touch = self._solved(self.contact.move(state, pose))

    def _solved(self, state: ContactState) -> FingerTouch:
        place = self.contact.elastomer.node_position + state.displacement
        moment = crossed(place - state.pose.position, state.force).sum(axis=0)
        size = np.linalg.norm(state.force, axis=1)
        return FingerTouch(
            state=state,
            wrench=np.concatenate([state.resultant, moment]),
            stiffness=self.contact.stiffness(state),
            middle=size @ place / size.sum() if size.any() else place.mean(axis=0),
            touches=bool(state.contact.any()),
            clearance=float(state.gap.min()),
        )


# A time step calls these for each finger; NumPy's own would take longer than the gels.
@kernel_part
def _cross(a: Array, b: Array) -> Array:
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


@kernel_part
def _size(vector: Array) -> float:
    return math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)


@kernel(nogil=False)
def shifted(wrench: Array, arm: Array) -> Array:
    """A wrench (6,) about a point that its own point is `arm` (3,) m away from."""
    found = np.empty(6)
    found[:3], found[3:] = wrench[:3], wrench[3:] + _cross(arm, wrench[:3])
    return found


@kernel(nogil=False)
def motion_between(from_place: Array, from_turn: Array, place: Array, turn: Array) -> Array:
    """Translation and rotation vector between two poses, (6,) m and rad."""
    between = turn @ from_turn.T
    doubled = np.array(
        [
            between[2, 1] - between[1, 2],
            between[0, 2] - between[2, 0],
            between[1, 0] - between[0, 1],
        ]
    )
    sine = 0.5 * _size(doubled)
    cosine = 0.5 * (between[0, 0] + between[1, 1] + between[2, 2] - 1.0)
    factor = math.atan2(sine, cosine) / sine if sine > 1e-9 else 1.0
    moved = np.empty(6)
    moved[:3], moved[3:] = place - from_place, 0.5 * factor * doubled
    return moved


@kernel(nogil=False)
def _ahead(
    tangent: tuple[Array, Array, Array, Array], place: Array, turn: Array, velocity: Array
) -> Array:
    """See FingerTouch.ahead; tangent: its wrench, stiffness, place and rotation."""
    wrench, stiffness, from_place, from_turn = tangent
    moved = motion_between(from_place, from_turn, place, turn) + DAMPING_S * velocity
    ahead = wrench + stiffness @ moved
    # The gel does not pull.
    return ahead if ahead[2] < 0 else np.zeros(6)


@kernel(nogil=False)
def _is_near(
    tangent: tuple[Array, Array, Array, Array], middle: Array, place: Array, turn: Array
) -> bool:
    """See FingerTouch.holds_at, of a gel that is touched."""
    wrench, stiffness, from_place, from_turn = tangent
    moved = motion_between(from_place, from_turn, place, turn)
    way = _size(moved[:3] + _cross(moved[3:], middle - from_place))
    change = shifted(stiffness @ moved, from_place - middle)
    size = math.sqrt(change[0] ** 2 + change[1] ** 2 + (NORMAL_WEIGHT * change[2]) ** 2)
    size += _size(change[3:]) / ARM_M
    return way < LONGEST_WAY_M and size < max(LEAST_CHANGE_N, -LARGEST_CHANGE * wrench[2])


@kernel(nogil=False)
def relative_velocity(held: Array, gel: Array, arm: Array, turn: Array) -> Array:
    """Of the object relative to the gel, (6,) m/s and rad/s, gel frame.

    held, gel: as MuJoCo has them, rotation first, world axes.  arm: from gel to object.
    turn (3, 3): of the gel.
    """
    along = held[3:] - gel[3:] - _cross(gel[:3], arm)
    found = np.empty(6)
    found[:3], found[3:] = turn.T @ along, turn.T @ (held[:3] - gel[:3])
    return found


@kernel(nogil=False)
def seen_from(place: Array, turn: Array, there: Array, turned: Array) -> tuple[Array, Array]:
    """A pose in the world, `there` and `turned`, as the frame at `place` and `turn` has it."""
    return turn.T @ (there - place), turn.T @ turned


@kernel(nogil=False)
def push(wrench: Array, turn: Array, arm: Array, applied: Array) -> None:
    """Add a wrench (6,) to what is applied to a body, (6,), in the world.

    turn (3, 3): of the wrench's frame.  arm: from the body's centre of mass to the wrench's point.
    """
    force = turn @ wrench[:3]
    applied[:3] += force
    applied[3:] += turn @ wrench[3:] + _cross(arm, force)
