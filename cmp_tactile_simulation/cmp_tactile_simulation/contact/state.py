"""The state of a contact between indenter and gel."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Pose:
    """T_gel_indenter: position (3,) m of the indenter's origin and rotation (3, 3), gel frame."""

    position: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))

    def to_gel(self, p_indenter: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (..., 3) of the indenter's frame in the gel frame, m."""
        return np.asarray(p_indenter @ self.rotation.T + self.position)

    def to_indenter(self, p_gel: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (..., 3) of the gel frame in the indenter's frame, m."""
        return np.asarray((p_gel - self.position) @ self.rotation)

    def towards(self, goal: Pose, share: float) -> Pose:
        """The pose at a share 0..1 of the way: straight line, constant rate of turning."""
        turn = Rotation.from_matrix(self.rotation.T @ goal.rotation).as_rotvec()
        rotation = self.rotation @ Rotation.from_rotvec(share * turn).as_matrix()
        return Pose(self.position + share * (goal.position - self.position), rotation)


@dataclass(frozen=True)
class Load:
    """What the indenter is to press with, gel frame.

    normal: N, positive presses into the gel (force on the gel along -z).  tangential: (x, y) N on
    the gel.  torque: N m on the gel, about the gel's z direction through the indenter's origin.
    """

    normal: float
    tangential: tuple[float, float] = (0.0, 0.0)
    torque: float = 0.0


@dataclass(frozen=True)
class ContactState:
    """A solved contact: N contact nodes, gel frame; forces act on the gel.

    force (N, 3) N.  displacement (N, 3) m of the contact nodes.
    gap (N,) m: mean distance to the indenter's surface over a node's hat, negative inside.
    contact, slipping (N,): nodes that carry force, and those of them at the friction cone's edge.
    """

    pose: Pose
    force: NDArray[np.float64]
    displacement: NDArray[np.float64]
    gap: NDArray[np.float64]
    contact: NDArray[np.bool_]
    slipping: NDArray[np.bool_]

    @property
    def resultant(self) -> NDArray[np.float64]:
        """Sum of the nodal forces, (3,) N."""
        return np.asarray(self.force.sum(axis=0))
