"""Friction that a contact uses, and how far it slips, from its pressure and tangential traction.

The quasi-static theory of friction with Coulomb's law under a known pressure p:

- A load (force F and torque T) can be carried with a friction coefficient mu only if it lies
  within the limit surface: F . v + T w <= mu sum p |v + w x r| for every rigid motion (v, w) of
  the object along the surface (Goyal, Ruina and Papadopoulos, Wear 143, 1991).  The least mu is
  the friction that is used; where all slides it is the friction coefficient, whatever the
  mixture of force and torque, and the motion for which it is found is that of the object.
- Before all slides, a rim slides and a core sticks: the traction is t = mu (p - p'), where p' is
  the pressure of the core alone (Cattaneo; Mindlin; for any shape Jaeger, and Ciavarella, J. Appl.
  Mech. 65, 1998).  p' vanishes where p is below a level; for Hertz's ellipse and cylinder it is
  exactly (p^2 - level^2)^(1/2).  So the traction is spread wider than the pressure as long as a
  core sticks, and like the pressure when all slides: that is seen in a single frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.measured import Contact
from cmp_tactile_processing.slip.surface_motion import DeformedNodes

Array = NDArray[np.float64]

ITERATIONS = 12
CONVERGED = 1e-4
# Of the pressure's peak: levels below which the pressure belongs to the sliding rim.
LEVELS = np.concatenate([np.linspace(0.1, 0.9, 17), [0.94, 0.97, 0.99, 1.0]])
# Under Hertz's pressure half of the normal force slides where a shear is spread so widely.
HERTZ_HALF_WIDTH = 1.18
# Below this slip ratio there, the pressure is not like Hertz's: balls and rods have 0.5 to 0.6, a
# box 0.2.
MIN_HERTZ_SLIP_RATIO = 0.35
TINY = 1e-12

# Fewer nodes than these have no rim that could be distinguished from a core.
LEAST_NODES = 6
# Standard deviation of a contact's tangential force where the force field does not give it, N.
ASSUMED_FORCE_STD = 5e-3


def _turning_widens() -> Array:
    """How much wider torsion is spread than a shear while the same core sticks, at the levels.

    Hertz's pressure: beyond 1 the width of a shear is (k^3 - k^5) / (1 - k^3) for a core of k
    radii, and that of torsion is 7/8 k^2 to 5 % of it (Abel's integral of flat stamps).
    """
    core = np.sqrt(1 - LEVELS[:-1] ** 2)
    shear = (core**3 - core**5) / (1 - core**3)
    return np.append(7 / 8 * core**2 / shear, 1.0)


TURNING_WIDENS = _turning_widens()


@dataclass(frozen=True)
class FrictionUse:
    """What a tangential load asks of a contact's friction.

    ratio: least friction coefficient that carries it.
    width: mean square distance of this load from the centre of pressure over what it would be if
    all slid: 1 then, and more while a core sticks.  turning: 0 where the object would move
    straight, 1 where it would turn about the centre of pressure.
    """

    ratio: float
    width: float
    turning: float


@dataclass(frozen=True)
class SlipProfile:
    """How slip spreads under a pressure; each (l,), from nearly all stuck to all sliding.

    width: see FrictionUse, falling to 1.  slip_ratio: share of the normal force that slides.
    used: tangential over normal force, of the friction coefficient.
    """

    width: Array
    slip_ratio: Array
    used: Array

    def at(self, use: FrictionUse) -> tuple[float, float]:
        """Slip ratio and used share of the friction where a load is so wide."""
        widths = 1 + (self.width - 1) * (1 + use.turning * (TURNING_WIDENS - 1))
        ratio = float(np.interp(-use.width, -widths, self.slip_ratio))
        return ratio, float(np.interp(-use.width, -widths, self.used))

    @property
    def is_rounded(self) -> bool:
        """Whether the pressure falls off towards the rim, as that of anything round does.

        Under a flat face it does not: the traction of a stuck one is spread like its pressure.
        """
        return (
            float(np.interp(-HERTZ_HALF_WIDTH, -self.width, self.slip_ratio)) > MIN_HERTZ_SLIP_RATIO
        )


@dataclass(frozen=True)
class Sliding:
    """How a contact can slide; k nodes.

    pressing (k,) N along each node's normal, not negative.  spread (k,): square distance from the
    centre of pressure in the metric in which its mean, weighted by pressing, is 1.
    motion (k, 3, 3): velocity along the surface at each node for unit motions of the object along
    two directions and, the third column, about the mean normal, as a velocity at `length` m.
    """

    pressing: Array
    spread: Array
    motion: Array
    length: float

    @classmethod
    def from_loads(cls, pressing: Array, arm: Array, normal: Array, axes: Array) -> Sliding:
        """For nodes at arm (k, 2) m from the centre of pressure along the axes (3, 2).

        normal: (k, 3) unit vectors.  Where the surface slopes the object slides along the slope.
        """
        motion, length = _motion(pressing, arm, normal, np.ascontiguousarray(axes))
        return cls(pressing, _spread(pressing, arm), motion, length)


def friction_use(sliding: Sliding, along: Array, blur: float) -> FrictionUse:
    """The friction that tangential forces along (k, 3) N use on a contact.

    blur: distance within which forces cannot be distinguished, m: next to a pivot they cancel.
    """
    length = float(sliding.length)
    ratio, width, turning = _use(
        sliding.pressing, sliding.motion, sliding.spread, np.ascontiguousarray(along), blur / length
    )
    return FrictionUse(ratio, width, turning)


def slip_profile(sliding: Sliding) -> SlipProfile:
    """How slip spreads from the rim inwards."""
    return SlipProfile(*_profile(sliding.pressing, sliding.spread))


@kernel
def _motion(pressing: Array, arm: Array, normal: Array, axes: Array) -> tuple[Array, float]:
    """Motion (k, 3, 3) and length of a Sliding."""
    square, total = 0.0, 0.0
    for k in range(len(pressing)):
        square += pressing[k] * (arm[k, 0] ** 2 + arm[k, 1] ** 2)
        total += pressing[k]
    length = max(np.sqrt(square / total), TINY)
    motion: Array = np.empty((len(pressing), 3, 3))
    for k in range(len(pressing)):
        for c in range(3):
            motion[k, c, 0], motion[k, c, 1] = axes[c, 0], axes[c, 1]
            motion[k, c, 2] = (axes[c, 1] * arm[k, 0] - axes[c, 0] * arm[k, 1]) / length
        for way in range(3):
            out = 0.0
            for c in range(3):
                out += normal[k, c] * motion[k, c, way]
            for c in range(3):
                motion[k, c, way] -= normal[k, c] * out
    return motion, length


@kernel
def _spread(pressing: Array, arm: Array) -> Array:
    """Square distance (k,) from the centre in the metric in which the pressure's mean is 1."""
    total, xx, xy, yy = 0.0, 0.0, 0.0, 0.0
    for k in range(len(pressing)):
        x, y = arm[k]
        total += pressing[k]
        xx, xy, yy = xx + pressing[k] * x * x, xy + pressing[k] * x * y, yy + pressing[k] * y * y
    ridge = 1e-6 * (xx + yy)
    xx, xy, yy = (xx + ridge) / total, xy / total, (yy + ridge) / total
    spread: Array = np.empty(len(pressing))
    for k in range(len(pressing)):
        x, y = arm[k]
        spread[k] = (yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy) / 2
    return spread


@kernel
def _profile(pressing: Array, spread: Array) -> tuple[Array, Array, Array]:
    """Width, slip ratio and used share of a SlipProfile."""
    width, slips, used = np.empty(len(LEVELS)), np.empty(len(LEVELS)), np.empty(len(LEVELS))
    peak, total, least = pressing.max(), pressing.sum(), np.inf
    for number, share in enumerate(LEVELS):
        level, along, wide, sliding = share * peak, 0.0, 0.0, 0.0
        for k in range(len(pressing)):
            part = pressing[k] - np.sqrt(max(pressing[k] ** 2 - level**2, 0.0))
            along += part
            wide += part * spread[k]
            if pressing[k] <= level:
                sliding += pressing[k]
        least = min(least, wide / along)
        width[number], slips[number], used[number] = least, sliding / total, along / total
    return width, slips, used


@kernel
def _use(
    pressing: Array, motion: Array, spread: Array, along: Array, blur: float
) -> tuple[float, float, float]:
    """Ratio, width and turning of a FrictionUse; blur over the length of the motion."""
    goal = np.zeros(3)
    for k in range(len(pressing)):
        for c in range(3):
            for way in range(3):
                goal[way] += along[k, c] * motion[k, c, way]
    z, ratio = _least_dissipation(pressing, motion, goal)
    load, wide, full, full_wide = 0.0, 0.0, 0.0, 0.0
    for k in range(len(pressing)):
        square, part = 0.0, 0.0
        for c in range(3):
            velocity = motion[k, c, 0] * z[0] + motion[k, c, 1] * z[1] + motion[k, c, 2] * z[2]
            square += velocity**2
            part += along[k, c] * velocity
        speed = np.sqrt(square) + TINY
        part /= speed
        sliding = pressing[k] * speed / np.hypot(speed, abs(z[2]) * blur)
        load += part
        wide += part * spread[k]
        full += sliding
        full_wide += sliding * spread[k]
    turning = z[2] ** 2 / (z[0] ** 2 + z[1] ** 2 + z[2] ** 2 + TINY)
    if not load > 0:
        return ratio, np.nan, turning
    return ratio, wide / load / full_wide * full, turning


@kernel_part
def _least_dissipation(pressing: Array, motion: Array, goal: Array) -> tuple[Array, float]:
    """The unit motion z (3,) with the least sum p |motion z| per goal . z; goal . z over it.

    Convex; solved by re-weighted least squares.
    """
    count = len(pressing)
    weight, speed = pressing.copy(), np.empty(count)
    least = np.inf
    z = np.zeros(3)
    for _ in range(ITERATIONS):
        z = _solved(_weighted_gram(weight, motion), goal)
        work = float(np.sum(goal * z))
        if not work > 0:
            return np.zeros(3), 0.0
        z /= work
        before, least = least, 0.0
        for k in range(count):
            square = 0.0
            for c in range(3):
                part = motion[k, c, 0] * z[0] + motion[k, c, 1] * z[1] + motion[k, c, 2] * z[2]
                square += part**2
            speed[k] = np.sqrt(square)
            least += pressing[k] * speed[k]
        if least > (1 - CONVERGED) * before:
            break
        # About a pivot inside the contact the speed vanishes.
        weight = pressing / np.maximum(speed, 1e-3 * speed.max())
    return z / np.sqrt(np.sum(z * z)), 1.0 / least


@kernel_part
def _weighted_gram(weight: Array, motion: Array) -> Array:
    """Sum of weight * motion' motion, (3, 3), made definite."""
    gram: Array = np.zeros((3, 3))
    for k in range(len(weight)):
        for c in range(3):
            for y in range(3):
                for z in range(3):
                    gram[y, z] += weight[k] * motion[k, c, y] * motion[k, c, z]
    ridge = 1e-9 * (gram[0, 0] + gram[1, 1] + gram[2, 2])
    for z in range(3):
        gram[z, z] += ridge
    return gram


@kernel
def _solved(matrix: Array, right: Array) -> Array:
    """Solution of a definite system of three."""
    left = matrix.copy()
    z: Array = right.copy()
    for i in range(3):
        for row in range(i + 1, 3):
            share = left[row, i] / left[i, i]
            for column in range(i, 3):
                left[row, column] -= share * left[i, column]
            z[row] -= share * z[i]
    for i in range(2, -1, -1):
        for column in range(i + 1, 3):
            z[i] -= left[i, column] * z[column]
        z[i] /= left[i, i]
    return z


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
    if len(nodes) < LEAST_NODES:
        return None
    loads = _loads(nodes, force, at.place, at.normal, at.rest, contact.covariance)
    if not (loads.normal_force > 0 and np.count_nonzero(loads.pressing) >= LEAST_NODES):
        return None
    sliding = Sliding.from_loads(loads.pressing, loads.arm, loads.normal, loads.axes)
    return ContactPatch(
        nodes=nodes,
        along=loads.along,
        sliding=sliding,
        normal_force=loads.normal_force,
        traction_ratio=loads.traction_ratio,
        use=friction_use(sliding, loads.along, at.spacing),
        profile=slip_profile(sliding),
        ratio_std=loads.ratio_std,
        centre=loads.centre,
        radius=math.sqrt(2.5) * sliding.length,
        node_count=len(at.rest),
        blur=at.spacing,
    )


class _Loads(NamedTuple):
    """Forces of a contact of k nodes.

    pressing (k,), along (k, 3) N: across and along the surface.  arm (k, 2) m: from the centre of
    pressure along axes (3, 2) across the mean normal.  normal (k, 3): of the nodes.  centre (2,) m:
    undeformed.  normal_force N: along the mean normal, NaN where a place or a force is not known.
    traction_ratio: tangential over normal force; ratio_std: its standard deviation.
    """

    pressing: Array
    along: Array
    arm: Array
    axes: Array
    normal: Array
    centre: Array
    normal_force: float
    traction_ratio: float
    ratio_std: float


@kernel
def _loads(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    nodes: NDArray[np.intp],
    force: Array,
    place: Array,
    normal: Array,
    rest: Array,
    covariance: Array,
) -> _Loads:
    """Of some nodes; force, place, normal, rest: of all, see `patch_of` and DeformedNodes.

    covariance (6, 6): of the contact's wrench.
    """
    count = len(nodes)
    pressing, along, arm = np.empty(count), np.empty((count, 3)), np.zeros((count, 2))
    mean, total, middle, centre = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(2)
    for k, node in enumerate(nodes):
        into = 0.0
        for c in range(3):
            into -= force[node, c] * normal[node, c]
        pressing[k] = max(into, 0.0)
        for c in range(3):
            along[k, c] = force[node, c] + pressing[k] * normal[node, c]
            total[c] += force[node, c]
            mean[c] += pressing[k] * normal[node, c]
            middle[c] += pressing[k] * place[node, c]
        for c in range(2):
            centre[c] += pressing[k] * rest[node, c]
    pressed = pressing.sum()
    mean /= np.sqrt(np.sum(mean * mean))
    axes = _tangents(mean)
    for k, node in enumerate(nodes):
        for c in range(3):
            for way in range(2):
                arm[k, way] += (place[node, c] - middle[c] / pressed) * axes[c, way]
    # NaN of any place, normal or force stays NaN.
    known = np.isfinite(along).all() and np.isfinite(place[nodes]).all()
    normal_force = -np.sum(total * mean) if known else np.nan
    ratio = np.hypot(np.sum(total * axes[:, 0]), np.sum(total * axes[:, 1])) / normal_force
    std = _ratio_std(covariance, mean, axes, ratio) / normal_force
    return _Loads(
        pressing, along, arm, axes, normal[nodes], centre / pressed, normal_force, ratio, std
    )


@kernel_part
def _tangents(normal: Array) -> Array:
    """Two unit vectors across a unit vector that points up, as columns (3, 2)."""
    x, y, z = normal
    across = np.hypot(x, z)
    # The first is the y axis times the normal, the second the normal times the first.
    first = z / across, 0.0, -x / across
    second = y * first[2], z * first[0] - x * first[2], -y * first[0]
    axes: Array = np.empty((3, 2))
    for c in range(3):
        axes[c, 0], axes[c, 1] = first[c], second[c]
    return axes


@kernel_part
def _ratio_std(covariance: Array, normal: Array, axes: Array, ratio: float) -> float:
    """Standard deviation, N, of a force with that covariance, across the traction ratio."""
    # Of the force along the normal; along the axes, and of both together.
    n = a = b = d = 0.0
    for i in range(3):
        for j in range(3):
            n += normal[i] * covariance[i, j] * normal[j]
            a += axes[i, 0] * covariance[i, j] * axes[j, 0]
            b += axes[i, 0] * covariance[i, j] * axes[j, 1]
            d += axes[i, 1] * covariance[i, j] * axes[j, 1]
    across = along = ASSUMED_FORCE_STD
    if np.isfinite(n + a + b + d):
        along = np.sqrt(max(n, 0.0))
        # The largest eigenvalue of the part across.
        across = np.sqrt(max((a + d) / 2 + np.hypot((a - d) / 2, b), 0.0))
    return float(np.hypot(across, ratio * along))
