"""The state of a contact between indenter and gel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_simulation.contact.pose import Pose

__all__ = ["ContactState", "Load"]


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
