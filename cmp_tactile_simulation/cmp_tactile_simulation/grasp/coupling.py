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
from cmp_tactile_simulation.contact.laws import ContactState, Pose

Array = NDArray[np.float64]

# The force also follows the rate of deformation by this time, s: a loss factor of 0.1 to 0.3 at the
# 30 to 90 Hz with which held objects of 50 to 300 g swing.
DAMPING_S = 5e-4
# The gel is solved again where its tangent changes the force by more than this share of the normal
# force, and by more than so much, N: it knows no end of sticking, and no more nodes that touch.
LARGEST_CHANGE, LEAST_CHANGE_N = 0.02, 0.01
# A gel that is touched follows no faster: a world that moves farther at once has no solution, m.
FARTHEST_M = 2e-3
# How far a contact reaches about, m, to compare moments with forces.
ARM_M = 4e-3


@dataclass(frozen=True)
class FingerTouch:
    """A solved gel, and what its force is near there.

    wrench (6,): force N on the gel and moment N m about the object's origin, gel frame.
    stiffness (6, 6): its change by motions of the object, m and rad.
    middle (3,) m: of the contact, gel frame.
    """

    state: ContactState
    wrench: Array
    stiffness: Array
    middle: Array

    @cached_property
    def touches(self) -> bool:
        """Whether the object touches the gel."""
        return bool(self.state.contact.any())

    @cached_property
    def _clearance(self) -> float:
        return float(self.state.gap.min())

    def ahead(self, pose: Pose, velocity: Array) -> Array:
        """The wrench (6,) on the gel with the object a little farther on, about its origin there.

        velocity (6,) m/s and rad/s: of the object relative to the gel, gel frame.
        """
        if not self.touches:
            return np.zeros(6)
        moved = self._moved(pose) + DAMPING_S * velocity
        wrench = self.wrench + self.stiffness @ moved
        # The gel does not pull.
        return np.asarray(wrench if wrench[2] < 0 else np.zeros(6))

    def holds_at(self, pose: Pose) -> bool:
        """Whether the tangent, or that nothing touches, still holds with the object there."""
        moved, begin = self._moved(pose), self.state.pose.position
        way, turn = math.sqrt(moved[:3] @ moved[:3]), math.sqrt(moved[3:] @ moved[3:])
        if not self.touches:
            reach = float(np.linalg.norm(self.middle - begin))
            return bool(way + reach * turn < self._clearance)
        change = self.stiffness @ moved
        force = change[:3]
        moment = shifted(change[3:], begin - self.middle, force)
        size = math.sqrt(force @ force) + math.sqrt(moment @ moment) / ARM_M
        return bool(size < max(LEAST_CHANGE_N, -LARGEST_CHANGE * self.wrench[2]))

    def _moved(self, pose: Pose) -> Array:
        """How the object has moved since, (6,) m and rad."""
        begin = self.state.pose
        return motion_between(begin.position, begin.rotation, pose.position, pose.rotation)


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
            msg = f"found a motion of {1e3 * way:.3g} mm in a time step, {limit}"
            raise ContactError(msg)
        self.touch = self._solved(self.contact.move(state, pose))

    def _solved(self, state: ContactState) -> FingerTouch:
        place = self.contact.elastomer.node_position + state.displacement
        moment = np.cross(place - state.pose.position, state.force).sum(axis=0)
        size = np.linalg.norm(state.force, axis=1)
        middle = size @ place / size.sum() if size.any() else place.mean(axis=0)
        wrench = np.concatenate([state.resultant, moment])
        return FingerTouch(state, wrench, self.contact.stiffness(state), middle)


# A time step calls these for each finger; NumPy's own would take longer than the gels.
@kernel_part
def _cross(a: Array, b: Array) -> Array:
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


@kernel
def shifted(moment: Array, arm: Array, force: Array) -> Array:
    """The moment (3,) about a point that the force's own point is `arm` away from."""
    return moment + _cross(arm, force)


@kernel
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
    sine = 0.5 * math.sqrt(doubled @ doubled)
    cosine = 0.5 * (between[0, 0] + between[1, 1] + between[2, 2] - 1.0)
    factor = math.atan2(sine, cosine) / sine if sine > 1e-9 else 1.0
    moved = np.empty(6)
    moved[:3], moved[3:] = place - from_place, 0.5 * factor * doubled
    return moved


@kernel
def relative_velocity(held: Array, gel: Array, arm: Array, turn: Array) -> Array:
    """Of the object relative to the gel, (6,) m/s and rad/s, gel frame.

    held, gel: as MuJoCo has them, rotation first, world axes.  arm: from gel to object.
    turn (3, 3): of the gel.
    """
    along = held[3:] - gel[3:] - _cross(gel[:3], arm)
    found = np.empty(6)
    found[:3], found[3:] = turn.T @ along, turn.T @ (held[:3] - gel[:3])
    return found
