"""What one frame shows of the friction in one contact."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.force_field import Contact
from cmp_tactile_processing.slip_friction import (
    FrictionUse,
    SlipProfile,
    friction_use,
    slip_profile,
)

__all__ = ["ContactPatch", "Reach", "TractionRecord", "patch_of"]

Array = NDArray[np.float64]

# Fewer nodes than these have no rim that could be told from a core.
LEAST_NODES = 6
# Standard deviation of a contact's tangential force where the force field does not tell it, N.
ASSUMED_FORCE_STD = 5e-3


@dataclass(frozen=True)
class TractionRecord:
    """Tangential forces (M, 3) N of a contact in some frame and its normal force, N.

    centre (2,) m: mean undeformed place of the pressure.
    """

    along: Array
    normal_force: float
    centre: Array


@dataclass(frozen=True)
class Reach:
    """What has changed since a record: the friction that it used, and how wide it is spread."""

    ratio: float
    load: float
    width: float


@dataclass(frozen=True)
class ContactPatch:
    """One contact in one frame; k nodes.

    nodes (k,).  pressing (k,) N along the mean normal.  along (k, 3) N: tangential forces.
    axes (3, 2): of the tangent plane.  arm (k, 2) m in it, from the centre of pressure.
    use: of the whole load.  ratio_std: of friction ratios.  radius: of a ball's contact that is
    as wide, m.  node_count: of the whole grid.
    """

    nodes: NDArray[np.intp]
    pressing: Array
    along: Array
    axes: Array
    arm: Array
    normal_force: float
    traction_ratio: float
    use: FrictionUse
    profile: SlipProfile
    ratio_std: float
    centre: Array
    radius: float
    node_count: int

    def record(self) -> TractionRecord:
        """What a later frame is compared with."""
        along = np.zeros((self.node_count, 3))
        along[self.nodes] = self.along
        return TractionRecord(along, self.normal_force, self.centre)

    def since(self, record: TractionRecord | None) -> Reach:
        """What came on top of a record, which grew and shrank as the normal force did."""
        if record is None:
            use = self.use
        else:
            share = self.normal_force / record.normal_force
            change = self.along - share * record.along[self.nodes]
            use = friction_use(self.pressing, self.arm, change @ self.axes)
        return Reach(use.ratio, use.ratio * self.normal_force, use.width)


def patch_of(
    contact: Contact, force: Array, place: Array, normal: Array, points: Array
) -> ContactPatch | None:
    """The friction in a contact; None where it is too small or unknown.

    force, place, normal (M, 3) and points (M, 2): of all nodes, see ContactSurface.
    """
    nodes = np.asarray(contact.nodes, np.intp)
    force, normal, place = force[nodes], normal[nodes], place[nodes]
    if len(nodes) < LEAST_NODES or not np.isfinite(normal).all() or not np.isfinite(force).all():
        return None
    pressure = np.maximum(-(force * normal).sum(axis=1), 0.0)
    mean = pressure @ normal
    if not np.linalg.norm(mean) > 0:
        return None
    mean /= np.linalg.norm(mean)
    total = force.sum(axis=0)
    normal_force = float(-total @ mean)
    pressing = pressure * np.maximum(normal @ mean, 0.0)
    if not (normal_force > 0 and np.count_nonzero(pressing) >= LEAST_NODES):
        return None
    axes = _tangents(mean)
    flat = place @ axes
    arm = flat - pressing @ flat / pressing.sum()
    along = force + pressure[:, None] * normal
    ratio = float(np.linalg.norm(total @ axes)) / normal_force
    return ContactPatch(
        nodes=nodes,
        pressing=pressing,
        along=along,
        axes=axes,
        arm=arm,
        normal_force=normal_force,
        traction_ratio=ratio,
        use=friction_use(pressing, arm, along @ axes),
        profile=slip_profile(pressing, arm),
        ratio_std=_ratio_std(contact.covariance[:3, :3], mean, axes, total),
        centre=pressing @ points[nodes] / pressing.sum(),
        radius=float(np.sqrt(1.25 * (pressing @ (arm**2).sum(axis=1)) / pressing.sum())),
        node_count=len(points),
    )


def _tangents(normal: Array) -> Array:
    """Two unit vectors across a unit vector that points up, as columns (3, 2)."""
    first = np.cross([0.0, 1.0, 0.0], normal)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)], axis=1)


def _ratio_std(covariance: Array, normal: Array, axes: Array, force: Array) -> float:
    """Standard deviation of the traction ratio of a force with that covariance."""
    pressing = float(-force @ normal)
    ratio = float(np.linalg.norm(force @ axes)) / pressing
    across = along = ASSUMED_FORCE_STD
    if np.isfinite(covariance).all():
        along = math.sqrt(max(float(normal @ covariance @ normal), 0.0))
        across = math.sqrt(max(float(np.linalg.eigvalsh(axes.T @ covariance @ axes)[-1]), 0.0))
    return math.hypot(across, ratio * along) / pressing
