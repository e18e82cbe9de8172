"""The state of a contact, and Signorini's and Coulomb's laws at the nodes that may be touched.

At each node the force f on the gel and the place of the node relative to the indenter obey,
along the indenter's own normal there,

    gap >= 0,  f_n >= 0,  gap f_n = 0,      |f_t| <= mu f_n,  f_t = -mu f_n slip / |slip|

The slip is what the node has moved along the indenter since the last solved state.  A nodal force
is spread over a hat and the node's displacement is the mean over it, so the gap is the mean over
the same hat: h^2 / (6 R) more than at the node, for a sphere of radius R on a flat gel with nodes
that lie h apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_simulation.indenters import Indenter, MeshIndenter

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

# Step of the difference that shows how a normal turns along the surface, m.
CURVATURE_STEP = 1e-7
TINY = 1e-300
# A normal force this much smaller than the largest is round-off, and its node open.
LEAST_SHARE = 1e-9


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
        if share == 1:
            return goal
        turn = Rotation.from_matrix(self.rotation.T @ goal.rotation).as_rotvec()
        rotation = self.rotation @ Rotation.from_rotvec(share * turn).as_matrix()
        return Pose(self.position + share * (goal.position - self.position), rotation)

    def seen_from(self, frame: Pose) -> Pose:
        """This pose in another frame, which is given in the same frame as this pose."""
        return Pose(frame.to_indenter(self.position), frame.rotation.T @ self.rotation)

    def turn_to(self, goal: Pose) -> float:
        """The angle between two poses, rad."""
        between = goal.rotation @ self.rotation.T
        sine = np.linalg.norm((between - between.T)[[2, 0, 1], [1, 2, 0]])
        return math.atan2(sine, between.trace() - 1)


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


@dataclass(frozen=True)
class Problem:
    """One step for k nodes that may touch.

    compliance: (3 m, 3 m) m/N of m >= k nodes.  nodes: (k,) their numbers in it.
    rest, before: (k, 3) m, gel frame, undeformed and in the last state, which had `before_pose`.
    touched: (k,) which of them carried force in the last state.
    bulge: (k,) m, by how much the mean gap over a node's hat is more than the gap at the node.
    """

    compliance: Array
    nodes: Index
    rest: Array
    before: Array
    before_pose: Pose
    touched: Mask
    bulge: Array
    indenter: Indenter
    friction: float

    @cached_property
    def own(self) -> Array:
        """Mean compliance of each node under its own force, (k,) m/N."""
        diagonal = self.compliance.diagonal().reshape(-1, 3)[self.nodes]
        return np.asarray(diagonal.mean(axis=1))

    def moved(self, force: Array) -> Array:
        """Displacement (k, 3) m of the nodes in the linear model."""
        loaded = np.flatnonzero(force.any(axis=1))
        return response(self.compliance, self.nodes, self.nodes[loaded], force[loaded])


@dataclass(frozen=True)
class View:
    """The k nodes as the indenter meets them, for some forces and some pose; gel frame.

    force (k, 3) N, of which pressing (k,) along the normal and along (k, 3) across it.
    place (k, 3) m deformed.  gap (k,) m.  normal (k, 3).  slip (k, 3) m, along the surface, from
    anchors (k, 3).
    """

    force: Array
    pose: Pose
    place: Array
    gap: Array
    normal: Array
    slip: Array
    anchors: Array
    pressing: Array
    along: Array


def look(
    problem: Problem, rest: Array, force: Array, pose: Pose, before: View | None = None
) -> View:
    """What the laws see.  rest: (k, 3) m, where the linear model puts the nodes without force.

    before: an earlier view of the problem, whose anchors hold for the same pose.
    """
    place = rest + problem.moved(force)
    gap, normal = problem.indenter.distance(pose.to_indenter(place))
    normal = normal @ pose.rotation.T
    held = before is not None and before.pose is pose
    anchors = before.anchors if before is not None and held else _anchors(problem, pose)
    pressing, along = _split(force, normal)
    return View(
        force=force,
        pose=pose,
        place=place,
        gap=gap + problem.bulge,
        normal=normal,
        slip=_split(place - anchors, normal)[1],
        anchors=anchors,
        pressing=pressing,
        along=along,
    )


@kernel
def _split(vectors: Array, normal: Array) -> tuple[Array, Array]:
    """The parts of vectors (k, 3) along unit normals, (k,), and across them, (k, 3)."""
    part, across = np.empty(len(vectors)), np.empty(vectors.shape)
    for k in range(len(vectors)):
        part[k] = _dot(vectors[k], normal[k])
        for c in range(3):
            across[k, c] = vectors[k, c] - part[k] * normal[k, c]
    return part, across


def bulge(indenter: Indenter, pose: Pose, place: Array, spacing: tuple[float, float]) -> Array:
    """By how much the mean gap over hats at place (k, 3) m is more than the gap there, (k,) m.

    spacing: of the nodes along x and y, m.  To second order: the variance of a hat is h^2 / 6 along
    either, and a sphere bends the same wherever it is met.  Edges that are sharper than a hat is
    wide have no curvature at that scale, and the gap at the node counts.
    """
    gap, normal = indenter.distance(pose.to_indenter(place))
    normal = normal @ pose.rotation.T
    # The facets of a mesh are flat: how it bends shows over the width of a hat.
    wide = isinstance(indenter, MeshIndenter)
    step = max(spacing) / np.sqrt(3) if wide else CURVATURE_STEP
    turning = _turning(indenter, pose, place - gap[:, None] * normal, normal, step)
    bend = spacing[0] * spacing[1] * np.trace(turning, axis1=1, axis2=2)
    sharpness = max(spacing) * np.linalg.norm(turning, axis=(1, 2))
    # Over a hat a mesh's edge looks as sharp as the hat is wide, and jumps from step to step.
    fading = (2 * sharpness) ** 8 if wide else sharpness**4
    return np.asarray(bend / (12 * (1 + fading)))


def law_residual(problem: Problem, view: View) -> tuple[Array, Array]:
    """Distances from Signorini's and from Coulomb's law at each node, (k,) and (k,) m.

    Forces count by what they move their own node.
    """
    forces = view.pressing, view.along
    return _residual(problem.own, problem.friction, view.gap, view.slip, forces)


@kernel
def _residual(
    own: Array, friction: float, gap: Array, slip: Array, forces: tuple[Array, Array]
) -> tuple[Array, Array]:
    signorini, coulomb = np.empty(len(gap)), np.zeros(len(gap))
    (pressing, along), trial = forces, np.empty(3)
    for k in range(len(gap)):
        signorini[k] = abs(min(gap[k], own[k] * pressing[k]))
        if pressing[k] > 0:
            for c in range(3):
                trial[c] = own[k] * along[k, c] - slip[k, c]
            limit = friction * own[k] * pressing[k]
            kept = min(1.0, limit / max(np.sqrt(_dot(trial, trial)), TINY))
            for c in range(3):
                coulomb[k] = max(coulomb[k], abs(own[k] * along[k, c] - kept * trial[c]))
    return signorini, coulomb


def on_cone(problem: Problem, view: View) -> Array:
    """The forces (k, 3) of a solved view put exactly on the cone."""
    least = LEAST_SHARE * view.pressing.max(initial=0.0)
    touches = (problem.own * view.pressing > view.gap) & (view.pressing > least)
    pressing = np.where(touches, view.pressing, 0.0)
    size = np.maximum(np.linalg.norm(view.along, axis=1), TINY)
    kept = np.minimum(1.0, problem.friction * pressing / size)
    return np.asarray(pressing[:, None] * view.normal + kept[:, None] * view.along)


@kernel
def tangents(normal: Array) -> Array:
    """Two unit vectors across each normal and each other, (2, k, 3)."""
    across = np.empty((2, *normal.shape))
    side = np.zeros(3)
    for k in range(len(normal)):
        side[0] = abs(normal[k, 0]) < 0.6
        side[1] = 1 - side[0]
        first, second = across[0, k], across[1, k]
        _cross(normal[k], side, first)
        length = np.sqrt(_dot(first, first))
        for c in range(3):
            first[c] /= length
        _cross(normal[k], first, second)
    return across


@kernel
def crossed(a: Array, b: Array) -> Array:
    """The cross products (k, 3) of vectors (k, 3)."""
    product = np.empty(a.shape)
    for k in range(len(a)):
        _cross(a[k], b[k], product[k])
    return product


@kernel_part(forceinline=True)
def _dot(a: Array, b: Array) -> Any:
    """The product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel_part(forceinline=True)
def _cross(a: Array, b: Array, out: Array) -> None:
    """The cross product of two vectors (3,)."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


def curvature(problem: Problem, view: View, nodes: Index) -> Array:
    """How the normal turns with the place: (k, 3, 3) 1/m, symmetric, zero along the normal."""
    return _turning(problem.indenter, view.pose, view.place[nodes], view.normal[nodes])


def _turning(
    indenter: Indenter, pose: Pose, place: Array, normal: Array, step: float = CURVATURE_STEP
) -> Array:
    across = tangents(normal)
    rate = (_normal(indenter, pose, place + step * across) - normal) / step
    if step > CURVATURE_STEP:
        before = (normal - _normal(indenter, pose, place - step * across)) / step
        rate = (rate + before) / 2
    return _symmetric(rate, normal, across)


@kernel
def _symmetric(rate: Array, normal: Array, across: Array) -> Array:
    """The turning (k, 3, 3) of normals (k, 3) by their rates along two directions (2, k, 3)."""
    turning = np.zeros((len(normal), 3, 3))
    for k in range(len(normal)):
        for n in range(2):
            along = _dot(rate[n, k], normal[k])
            for i in range(3):
                change = rate[n, k, i] - along * normal[k, i]
                for j in range(3):
                    turning[k, i, j] += change * across[n, k, j]
        for i in range(3):
            for j in range(i):
                mean = (turning[k, i, j] + turning[k, j, i]) / 2
                turning[k, i, j] = turning[k, j, i] = mean
    return turning


def _normal(indenter: Indenter, pose: Pose, place: Array) -> Array:
    _, normal = indenter.distance(pose.to_indenter(place).reshape(-1, 3))
    return np.asarray((normal @ pose.rotation.T).reshape(place.shape))


def _anchors(problem: Problem, pose: Pose) -> Array:
    """Where each node would be now if it had stuck to the indenter since it touched it.

    A node that comes to touch during the step stays behind until then: for the share of the
    step in which the indenter, moving alone, has not reached it.
    """
    carried = pose.to_gel(problem.before_pose.to_indenter(problem.before))
    new = np.flatnonzero(~problem.touched)
    before = problem.before[new]
    start, _ = problem.indenter.distance(problem.before_pose.to_indenter(before))
    end, _ = problem.indenter.distance(pose.to_indenter(before))
    closing = start - end
    start, end = start + problem.bulge[new], end + problem.bulge[new]
    free = np.where(end < 0, start / np.where(closing > 0, closing, 1.0), 1.0)
    free = np.clip(free, 0.0, 1.0)[:, None]
    carried[new] += free * (before - carried[new])
    return carried


@kernel
def response(compliance: Array, at: Index, loaded: Index, force: Array) -> Array:
    """Displacement (k, 3) at nodes `at` under forces (l, 3) on the nodes `loaded`.

    at, loaded: numbers of nodes in the compliance (3 m, 3 m).
    """
    moved = np.zeros((len(at), 3))
    for i in range(len(at)):
        for a in range(3):
            row = compliance[3 * at[i] + a]
            total = 0.0
            for j in range(len(loaded)):
                first = 3 * loaded[j]
                total += row[first] * force[j, 0]
                total += row[first + 1] * force[j, 1]
                total += row[first + 2] * force[j, 2]
            moved[i, a] = total
    return moved


@kernel
def condensed_system(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    compliance: Array, nodes: Index, first: Index, test: Array, trial: Array, local: Array
) -> NDArray[np.float32]:
    """Matrix (m, m) of test[r] . compliance . trial[c] between the unknowns of the nodes.

    nodes: (k,) numbers in the compliance.  first: (k + 1,) node i has the unknowns from first[i]
    to first[i + 1].  test, trial: (m, 3) directions.  local: (m, 3), local[r] . trial[c] is
    added between unknowns of one node.  Single precision is enough: the solver iterates on a
    residual in double precision.
    """
    count = len(test)
    matrix = np.empty((count, count), dtype=np.float32)
    for i in range(len(nodes)):
        rows = compliance[3 * nodes[i] : 3 * nodes[i] + 3]
        for r in range(first[i], first[i + 1]):
            t0, t1, t2 = test[r]
            for j in range(len(nodes)):
                c = 3 * nodes[j]
                w0 = t0 * rows[0, c] + t1 * rows[1, c] + t2 * rows[2, c]
                w1 = t0 * rows[0, c + 1] + t1 * rows[1, c + 1] + t2 * rows[2, c + 1]
                w2 = t0 * rows[0, c + 2] + t1 * rows[1, c + 2] + t2 * rows[2, c + 2]
                for q in range(first[j], first[j + 1]):
                    matrix[r, q] = w0 * trial[q, 0] + w1 * trial[q, 1] + w2 * trial[q, 2]
            for q in range(first[i], first[i + 1]):
                matrix[r, q] += np.dot(local[r], trial[q])
    return matrix
