"""The contact force on the gel, as the force stage returns it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum, IntFlag

import numpy as np
from numpy.typing import NDArray

__all__ = ["Contact", "ForceField", "ForceFlag", "SlipEstimate", "SlipState"]

NAN = float("nan")


class SlipState(IntEnum):
    """State of the contact; the codes of ForceField.msg."""

    UNKNOWN = 0
    NO_CONTACT = 1
    STICK = 2
    INCIPIENT = 3
    FULL = 4


class ForceFlag(IntFlag):
    """What a user must know about a ForceField; the bits of ForceField.msg."""

    NONE = 0
    FEW_MARKERS = 1  # too few markers were seen: all is NaN
    AT_BORDER = 2  # contact reaches the edge of the marker area and may go on beyond it
    BEYOND_MARKERS = 4  # the markers at the edge move as only a force beyond them would move them
    HIDDEN_CONTACT = 8  # markers under the contact are missing
    NO_DEPTH = 16  # one view: the normal force is inferred, not measured
    LARGE_PRESS = 32  # pressed so far that the linear model is wrong, and it was not corrected
    NOT_CONVERGED = 64  # the large-press correction did not settle
    POOR_FIT = 128  # no force explains how the markers moved: wrong sensor, reference or marker
    IMPLAUSIBLE = 256  # the markers show what no such gel can do or bear: all is NaN


@dataclass(frozen=True)
class SlipEstimate:
    """Whether a contact slides; NaN where it is not known.

    slip_ratio: share of the contact, weighted by normal force, that slides, 0 to 1: above 0 and
    below 1 slip is incipient.
    traction_ratio: tangential over normal force of the contact, the friction that it uses.
    friction_coefficient: of what slides, and its standard deviation friction_std; NaN where
    nothing slides, as a contact that sticks only shows that it is at least traction_ratio.
    """

    state: SlipState = SlipState.UNKNOWN
    slip_ratio: float = NAN
    traction_ratio: float = NAN
    friction_coefficient: float = NAN
    friction_std: float = NAN


@dataclass(frozen=True)
class Contact:
    """One of the separate contacts of a ForceField, gel frame.

    nodes (K,): numbers of the force nodes.  wrench (6,), covariance (6, 6), centre_of_pressure
    (3,), area: as in ForceField, of this contact alone.  outline (L, 3) m: closed polygon on the
    deformed contact surface, counter-clockwise as seen from outside, first point not repeated.
    at_border: it reaches the edge of the marker area and may go on beyond it.
    """

    nodes: NDArray[np.intp]
    wrench: NDArray[np.float64]
    covariance: NDArray[np.float64]
    area: float
    centre_of_pressure: NDArray[np.float64]
    outline: NDArray[np.float64]
    at_border: bool
    slip: SlipEstimate = SlipEstimate()


def _unknown_covariance() -> NDArray[np.float64]:
    return np.full((6, 6), NAN)


@dataclass(frozen=True)
class ForceField:
    """Force that the object exerts on the gel, gel frame; a press has negative z.

    rows, cols: shape of the node grid, M = rows * cols, node (i, j) at i * cols + j.
    position (M, 3) m: undeformed contact surface.  force (M, 3) N per node, 0 where there is no
    contact; force_std (M, 3) N: its standard deviations.  contact (M,) bool.
    wrench (6,): resultant force, N, and moment about reference_point, N m; forces act where their
    nodes have moved to, and so does centre_of_pressure (3,) m, NaN without contact.
    wrench_covariance (6, 6): of noise, resolution and, where calibrated, material.
    contact_area m^2, undeformed.  contacts: each separate contact, the strongest first.
    slip_state: that of `slip`, which sums up all contacts.
    valid_fraction: share of the markers that the force rests on, 0 to 1.
    noise_scale: noise of the displacements over what the parameters say of it.
    corrected: whether the large-press correction was applied.
    relaxed: whether the relaxation of the gel was taken out.
    All values are NaN (contact False) where too few markers were seen, and where they
    show what no gel of this description can.
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
    force_std: NDArray[np.float64] | None = None
    wrench_covariance: NDArray[np.float64] = field(default_factory=_unknown_covariance)
    contacts: tuple[Contact, ...] = ()
    slip: SlipEstimate = SlipEstimate()
    flags: ForceFlag = ForceFlag.NONE
    noise_scale: float = NAN
    corrected: bool = False
    relaxed: bool = False

    @property
    def wrench_std(self) -> NDArray[np.float64]:
        """Standard deviations of the wrench, (6,) N and N m."""
        return np.asarray(np.sqrt(np.diag(self.wrench_covariance)))
