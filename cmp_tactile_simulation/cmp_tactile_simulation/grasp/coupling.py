"""What the gel of a fingertip and an object that moves in a rigid world do to each other.

The rigid world takes steps of half a millisecond; the gel is solved where the object has moved
noticeably over it.  In between its force follows its tangent stiffness (a quasi-static gel has no
other memory than its friction), and is damped a little, as gels are.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

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

    @property
    def touches(self) -> bool:
        """Whether the object touches the gel."""
        return bool(self.state.contact.any())

    def ahead(self, pose: Pose, velocity: Array) -> Array:
        """The wrench (6,) on the gel with the object a little farther on, about its origin there.

        velocity (6,) m/s and rad/s: of the object relative to the gel, gel frame.
        """
        if not self.touches:
            return np.zeros(6)
        begin = self.state.pose
        moved = np.concatenate([pose.position - begin.position, _turn(begin, pose)])
        wrench = self.wrench + self.stiffness @ (moved + DAMPING_S * velocity)
        # The gel does not pull.
        return np.asarray(wrench if wrench[2] < 0 else np.zeros(6))

    def holds_at(self, pose: Pose) -> bool:
        """Whether the tangent, or that nothing touches, still holds with the object there."""
        begin = self.state.pose
        turn = _turn(begin, pose)
        if not self.touches:
            reach = float(np.linalg.norm(self.middle - begin.position))
            way = np.linalg.norm(pose.position - begin.position) + reach * np.linalg.norm(turn)
            return bool(way < self.state.gap.min())
        change = self.stiffness @ np.concatenate([pose.position - begin.position, turn])
        force, moment = change[:3], change[3:] - np.cross(self.middle - begin.position, change[:3])
        size = np.linalg.norm(force) + np.linalg.norm(moment) / ARM_M
        return bool(size < max(LEAST_CHANGE_N, -LARGEST_CHANGE * self.wrench[2]))


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
        self.touch = self._solved(self.contact.move(state, pose))

    def _solved(self, state: ContactState) -> FingerTouch:
        place = self.contact.elastomer.node_position + state.displacement
        moment = np.cross(place - state.pose.position, state.force).sum(axis=0)
        size = np.linalg.norm(state.force, axis=1)
        middle = size @ place / size.sum() if size.any() else place.mean(axis=0)
        wrench = np.concatenate([state.resultant, moment])
        return FingerTouch(state, wrench, self.contact.stiffness(state), middle)


def _turn(begin: Pose, end: Pose) -> Array:
    """Rotation vector (3,) between two poses, rad, gel frame."""
    turn = Rotation.from_matrix(end.rotation @ begin.rotation.T)
    return np.asarray(turn.as_rotvec())
