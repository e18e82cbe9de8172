"""The contact force on the gel, as the force stage returns it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

__all__ = ["ForceField", "SlipState"]


class SlipState(IntEnum):
    """State of the contact; the codes of ForceField.msg."""

    UNKNOWN = 0
    NO_CONTACT = 1
    STICK = 2
    INCIPIENT = 3
    FULL = 4


@dataclass(frozen=True)
class ForceField:
    """Force that the object exerts on the gel, gel frame; a press has negative z.

    rows, cols: shape of the node grid, M = rows * cols, node (i, j) at i * cols + j.
    position (M, 3) m: undeformed contact surface.  force (M, 3) N per node.  contact (M,) bool.
    wrench (6,): resultant force, N, and moment about reference_point, N m; forces act where their
    nodes have moved to, and so does centre_of_pressure (3,) m, NaN without contact.
    contact_area m^2, undeformed.
    valid_fraction: share of the markers that the force rests on, 0 to 1.
    All values are NaN (contact False) where too few markers were seen to tell.
    """

    rows: int
    cols: int
    position: NDArray[np.float64]
    force: NDArray[np.float64]
    contact: NDArray[np.bool_]
    wrench: NDArray[np.float64]
    contact_area: float
    centre_of_pressure: NDArray[np.float64]
    reference_point: NDArray[np.float64]
    slip_state: SlipState
    valid_fraction: float
    regularization: float
    young: float
    poisson: float
