"""Where a rigid indenter is."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

__all__ = ["Pose"]


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
