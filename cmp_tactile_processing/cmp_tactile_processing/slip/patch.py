"""What one frame shows of the friction in one contact."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.force_field import Contact
from cmp_tactile_processing.slip.friction import (
    FrictionUse,
    Sliding,
    SlipProfile,
    friction_use,
    slip_profile,
)
from cmp_tactile_processing.slip.surface_motion import DeformedNodes

__all__ = ["ContactPatch", "TractionRecord", "patch_of"]

Array = NDArray[np.float64]

# Fewer nodes than these have no rim that could be told from a core.
LEAST_NODES = 6
# Standard deviation of a contact's tangential force where the force field does not tell it, N.
ASSUMED_FORCE_STD = 5e-3


@dataclass(frozen=True)
class TractionRecord:
    """Tangential forces (M, 3) N of a contact in some frame and its normal force, N.

    along is None where they are too small to matter.  centre (2,) m: mean undeformed place of the
    pressure.
    """

    along: Array | None
    normal_force: float
    centre: Array


@dataclass(frozen=True)
class ContactPatch:
    """One contact in one frame; k nodes.

    nodes (k,).  along (k, 3) N: tangential forces.  normal_force N: along the mean normal.
    use: of the whole load.  ratio_std: of friction ratios.  radius: of a ball's contact that is
    as wide, m.  node_count: of the whole grid.  blur: see friction_use.
    """

    nodes: NDArray[np.intp]
    along: Array
    sliding: Sliding
    normal_force: float
    traction_ratio: float
    use: FrictionUse
    profile: SlipProfile
    ratio_std: float
    centre: Array
    radius: float
    node_count: int
    blur: float

    def record(self, *, small: bool = False) -> TractionRecord:
        """What a later frame is compared with.  small: its tangential forces count as none.

        What spreads outwards under a press is tangential, too, but makes no load, and later is
        elsewhere on the gel.
        """
        along = None
        if not small:
            along = np.zeros((self.node_count, 3))
            along[self.nodes] = self.along
        return TractionRecord(along, self.normal_force, self.centre)

    def since(self, record: TractionRecord) -> FrictionUse:
        """The friction used by what came on top of a record, which grew as the normal force."""
        if record.along is None:
            return self.use
        share = self.normal_force / record.normal_force
        change = self.along - share * record.along[self.nodes]
        return friction_use(self.sliding, change, self.blur)


def patch_of(contact: Contact, force: Array, at: DeformedNodes) -> ContactPatch | None:
    """The friction in a contact; None where it is too small or unknown.

    force (M, 3) N.
    """
    nodes = np.asarray(contact.nodes, np.intp)
    force, normal, place = force[nodes], at.normal[nodes], at.place[nodes]
    known = all(np.isfinite(values).all() for values in (force, normal, place))
    if len(nodes) < LEAST_NODES or not known:
        return None
    pressure = np.maximum(-(force * normal).sum(axis=1), 0.0)
    mean = pressure @ normal
    if not np.linalg.norm(mean) > 0:
        return None
    mean /= np.linalg.norm(mean)
    total = force.sum(axis=0)
    normal_force = float(-total @ mean)
    if not (normal_force > 0 and np.count_nonzero(pressure) >= LEAST_NODES):
        return None
    axes = _tangents(mean)
    flat = place @ axes
    arm = flat - pressure @ flat / pressure.sum()
    along = force + pressure[:, None] * normal
    sliding = Sliding.from_loads(pressure, arm, normal, axes)
    return ContactPatch(
        nodes=nodes,
        along=along,
        sliding=sliding,
        normal_force=normal_force,
        traction_ratio=float(np.linalg.norm(total @ axes)) / normal_force,
        use=friction_use(sliding, along, at.spacing),
        profile=slip_profile(sliding),
        ratio_std=_ratio_std(contact.covariance[:3, :3], mean, axes, total),
        centre=pressure @ at.rest[nodes] / pressure.sum(),
        radius=math.sqrt(2.5) * sliding.length,
        node_count=len(at.rest),
        blur=at.spacing,
    )


def _tangents(normal: Array) -> Array:
    """Two unit vectors across a unit vector that points up, as columns (3, 2)."""
    x, y, z = (float(part) for part in normal)
    across = math.hypot(x, z)
    # The first is the y axis times the normal, the second the normal times the first.
    first = z / across, 0.0, -x / across
    second = y * first[2], z * first[0] - x * first[2], -y * first[0]
    return np.asarray(np.array([first, second]).T)


def _ratio_std(covariance: Array, normal: Array, axes: Array, force: Array) -> float:
    """Standard deviation of the traction ratio of a force with that covariance."""
    pressing = float(-force @ normal)
    ratio = float(np.linalg.norm(force @ axes)) / pressing
    across = along = ASSUMED_FORCE_STD
    if np.isfinite(covariance).all():
        along = math.sqrt(max(float(normal @ covariance @ normal), 0.0))
        across = math.sqrt(max(_largest_eigenvalue(axes.T @ covariance @ axes), 0.0))
    return math.hypot(across, ratio * along) / pressing


def _largest_eigenvalue(matrix: Array) -> float:
    """Of a symmetric matrix (2, 2)."""
    a, b, d = float(matrix[0, 0]), float(matrix[0, 1]), float(matrix[1, 1])
    return (a + d) / 2 + math.hypot((a - d) / 2, b)
