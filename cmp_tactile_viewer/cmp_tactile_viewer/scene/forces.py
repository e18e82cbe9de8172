"""Forces, contacts and errors as arrows, lines and ellipsoids, in mm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.drawing import SLIP_COLOURS, closed, turning_arrow
from cmp_tactile_processing.measured import Contact, ForceField, SlipState, Surface
from cmp_tactile_viewer.scene.surface_mesh import MM

# Drawn lengths at gain 1: of a node's force, of a contact's, of its moment.
NODE_MM_PER_N, CONTACT_MM_PER_N, MOMENT_MM_PER_NM = 25.0, 1.0, 500.0
# Shorter arrows would only be dots.
SHORTEST_MM = 0.1
# The ellipsoid holds the true force in 95 % of the cases: chi-square with three degrees of freedom.
ELLIPSOID_SIGMA = 2.796


def force_arrows(force: ForceField, gain: float) -> NDArray[np.float64]:
    """Ends (N, 2, 3) of an arrow for each node in contact; it presses on the node with its tip."""
    tips = MM * force.position[force.contact]
    return _long_enough(tips - gain * NODE_MM_PER_N * force.force[force.contact], tips)


def displacement_arrows(surface: Surface, gain: float) -> NDArray[np.float64]:
    """Ends (N, 2, 3) of an arrow for each marker, from where it rests."""
    tails = MM * surface.reference.reshape(-1, 3)
    return _long_enough(tails, tails + gain * MM * surface.displacement.reshape(-1, 3))


def contact_arrow(contact: Contact, gain: float) -> NDArray[np.float64]:
    """Ends (2, 3) of the arrow of a contact's force, which ends at its centre of pressure."""
    tip = MM * contact.centre_of_pressure
    return np.stack([tip - gain * CONTACT_MM_PER_N * contact.wrench[:3], tip])


def moment_lines(
    contact: Contact, moment_point: NDArray[np.float64], gain: float
) -> NDArray[np.float64]:
    """Sides (S, 2, 3) of the turning arrow of a contact's moment about its centre of pressure."""
    centre, wrench = contact.centre_of_pressure, contact.wrench
    moment = wrench[3:] - np.cross(centre - moment_point, wrench[:3])
    return MM * turning_arrow(centre, gain * MOMENT_MM_PER_NM / MM * moment)


def outline(contact: Contact) -> NDArray[np.float64]:
    """Sides (S, 2, 3) of a contact's boundary."""
    return MM * closed(contact.outline)


def slip_colour(state: SlipState) -> tuple[int, int, int]:
    """RGB, 0 to 255, as RViz shows it."""
    red, green, blue, _ = (round(255 * part) for part in SLIP_COLOURS[state])
    return red, green, blue


@dataclass(frozen=True)
class Ellipsoid:
    """centre (3,) mm; half axes (3,) mm; orientation, a quaternion (w, x, y, z)."""

    centre: NDArray[np.float64]
    half_axes: NDArray[np.float64]
    orientation: NDArray[np.float64]


def error_ellipsoid(contact: Contact, gain: float) -> Ellipsoid | None:
    """Where the tail of `contact_arrow` may really be, in 95 % of the cases; None if not known."""
    covariance = contact.covariance[:3, :3]
    if not (np.isfinite(covariance).all() and np.isfinite(contact.wrench).all()):
        return None
    variance, axes = np.linalg.eigh(covariance)
    if np.linalg.det(axes) < 0:
        axes[:, 0] = -axes[:, 0]
    x, y, z, w = Rotation.from_matrix(axes).as_quat()
    half = ELLIPSOID_SIGMA * gain * CONTACT_MM_PER_N * np.sqrt(np.maximum(variance, 0.0))
    return Ellipsoid(contact_arrow(contact, gain)[0], half, np.array([w, x, y, z]))


def _long_enough(tails: NDArray[np.float64], tips: NDArray[np.float64]) -> NDArray[np.float64]:
    length = np.linalg.norm(tips - tails, axis=-1)
    return np.asarray(np.stack([tails, tips], axis=1)[length > SHORTEST_MM])
