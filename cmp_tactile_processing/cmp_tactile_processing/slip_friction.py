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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["FrictionUse", "SlipProfile", "friction_use", "slip_profile"]

Array = NDArray[np.float64]

ITERATIONS = 12
CONVERGED = 1e-4
# Of the pressure's peak: levels below which the pressure belongs to the sliding rim.
LEVELS = np.concatenate([np.linspace(0.1, 0.9, 17), [0.94, 0.97, 0.99, 1.0]])
TINY = 1e-12


@dataclass(frozen=True)
class FrictionUse:
    """What a tangential load asks of a contact's friction.

    ratio: least friction coefficient that carries it.  direction (k, 2): of the traction at each
    node if all slid, unit vectors.  load: traction along these directions, N.
    width: mean square distance of this load from the centre of pressure over that of the
    pressure, each measured in its own principal spread: 1 where all slides.
    """

    ratio: float
    direction: Array
    load: float
    width: float


@dataclass(frozen=True)
class SlipProfile:
    """How slip spreads under a pressure; each (l,), from nearly all stuck to all sliding.

    width: see FrictionUse, falling to 1.  slip_ratio: share of the normal force that slides.
    used: tangential over normal force, of the friction coefficient.
    """

    width: Array
    slip_ratio: Array
    used: Array

    def at(self, width: float) -> tuple[float, float]:
        """Slip ratio and used share of the friction where the load is so wide."""
        width = min(max(width, float(self.width[-1])), float(self.width[0]))
        ratio = float(np.interp(-width, -self.width, self.slip_ratio))
        return ratio, float(np.interp(-width, -self.width, self.used))


def friction_use(pressing: Array, arm: Array, along: Array) -> FrictionUse:
    """The friction that tangential forces along (k, 2) N use on a contact.

    pressing (k,) N, not negative, not all 0.  arm (k, 2) m: from the centre of pressure.
    """
    spread = _spread(pressing, arm)
    length = float(np.sqrt((pressing @ (arm**2).sum(axis=1)) / pressing.sum())) or TINY
    # Columns: along the first axis, along the second, turning (as a velocity at `length`).
    turning = np.stack([-arm[:, 1], arm[:, 0]], axis=1) / length
    motion = np.zeros((len(pressing), 2, 3))
    motion[:, 0, 0] = motion[:, 1, 1] = 1.0
    motion[:, :, 2] = turning
    goal = np.einsum("kc,kcz->z", along, motion)
    direction, ratio = _least_dissipation(pressing, motion, goal)
    part = (along * direction).sum(axis=1)
    load = float(part.sum())
    width = float(part @ spread) / load if load > 0 else float("nan")
    return FrictionUse(ratio, direction, load, width)


def slip_profile(pressing: Array, arm: Array) -> SlipProfile:
    """How slip spreads from the rim inwards under nodal pressing forces (k,) N; arm (k, 2) m."""
    level = LEVELS[:, None] * pressing.max()
    core = np.sqrt(np.maximum(pressing**2 - level**2, 0.0))
    along = pressing - core
    total = along.sum(axis=1)
    width = along @ _spread(pressing, arm) / total
    return SlipProfile(
        width=np.minimum.accumulate(width),
        slip_ratio=((pressing <= level) * pressing).sum(axis=1) / pressing.sum(),
        used=total / pressing.sum(),
    )


def _spread(pressing: Array, arm: Array) -> Array:
    """Square distance (k,) from the centre in the metric in which the pressure's mean is 1."""
    moment = np.einsum("k,ka,kb->ab", pressing, arm, arm) / pressing.sum()
    moment += 1e-6 * np.trace(moment) * np.eye(2)
    return np.asarray(np.einsum("ka,ab,kb->k", arm, np.linalg.inv(moment), arm) / 2)


def _least_dissipation(pressing: Array, motion: Array, goal: Array) -> tuple[Array, float]:
    """Directions (k, 2) of the motion with the least sum p |motion z| for which goal . z = 1.

    Convex; solved by re-weighted least squares.  Also the friction ratio, the inverse of that sum.
    """
    gram = np.einsum("kcy,kcz->kyz", motion, motion)
    weight, least = pressing, np.inf
    for _ in range(ITERATIONS):
        matrix = np.einsum("k,kyz->yz", weight, gram)
        matrix += 1e-9 * np.trace(matrix) * np.eye(3)
        z = np.linalg.solve(matrix, goal)
        work = float(goal @ z)
        if not work > 0:
            return np.zeros(motion.shape[:2]), 0.0
        velocity = motion @ (z / work)
        speed = np.sqrt((velocity**2).sum(axis=1)) + TINY
        before, least = least, float(pressing @ speed)
        if least > (1 - CONVERGED) * before:
            break
        # About a pivot inside the contact the speed vanishes.
        weight = pressing / np.maximum(speed, 1e-3 * speed.max())
    return velocity / speed[:, None], 1.0 / least
