"""Frictional contact of a rigid indenter on the condensed compliance of a gel.

At each node that may touch, the force f on the gel and the place of the node relative to the
indenter obey Signorini's and Coulomb's laws along the indenter's own normal there:

    gap >= 0,  f_n >= 0,  gap f_n = 0,      |f_t| <= mu f_n,  f_t = -mu f_n slip / |slip|

The slip is what the node has moved along the indenter since the last solved state.  Both laws
are one non-smooth equation (Alart and Curnier 1991), solved by Newton's method: each iteration
knows which nodes are open, which stick and which slide, takes normals and gaps at the nodes'
latest places, and solves for the rest.  The same system holds the indenter's motion where the
load is given instead of the place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, lu_factor, lu_solve
from scipy.spatial.transform import Rotation

from cmp_tactile_simulation.contact_kernels import condensed_system, response
from cmp_tactile_simulation.contact_settings import ContactSettings
from cmp_tactile_simulation.errors import SimulationError
from cmp_tactile_simulation.indenter import Indenter
from cmp_tactile_simulation.pose import Pose

__all__ = ["Guess", "NotConvergedError", "Problem", "Solution", "solve", "way_between"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

# Length that makes a torque comparable with a force, m: that of a fingertip's contact.
TURN_ARM = 2e-3
# Directions in which the contact is this much softer than in its stiffest are not driven.
SOFTEST = 1e-6
# A step under load that needs more than this many times the longest step is cut short.
LONGEST_WAY = 4.0


class NotConvergedError(SimulationError):
    """A step that was not solved.  residual: m, infinite where the step was abandoned."""

    def __init__(self, residual: float) -> None:
        super().__init__(f"the contact did not converge: residual {residual:.3g} m")
        self.residual = residual


@dataclass(frozen=True)
class Problem:
    """One step for k nodes that may touch.

    compliance: (3 m, 3 m) m/N of m >= k nodes.  nodes: (k,) their numbers in it.
    rest, before: (k, 3) m, gel frame, undeformed and in the last state, which had `before_pose`.
    touched: (k,) which of them carried force in the last state.
    """

    compliance: Array
    nodes: Index
    rest: Array
    before: Array
    before_pose: Pose
    touched: Mask
    indenter: Indenter
    friction: float

    @property
    def own(self) -> Array:
        """Mean compliance of each node under its own force, (k,) m/N."""
        diagonal = self.compliance.diagonal().reshape(-1, 3)[self.nodes]
        return np.asarray(diagonal.mean(axis=1))

    def moved(self, force: Array) -> Array:
        """Displacement (k, 3) m of the nodes in the linear model."""
        loaded = np.flatnonzero(force.any(axis=1))
        return response(self.compliance, self.nodes, self.nodes[loaded], force[loaded])


@dataclass(frozen=True)
class Guess:
    """Where the iteration begins: forces (k, 3) N, the pose, and which nodes slide (k,)."""

    force: Array
    pose: Pose
    sliding: Mask


@dataclass(frozen=True)
class Solution:
    """A solved step; arrays of the k nodes.  place: deformed positions, m, gel frame."""

    force: Array
    pose: Pose
    place: Array
    sliding: Mask
    residual: float


@dataclass(frozen=True)
class _View:
    """The nodes as the indenter meets them, for some forces and some pose."""

    force: Array
    pose: Pose
    place: Array
    gap: Array
    normal: Array
    slip: Array
    pressing: Array
    along: Array


@dataclass(frozen=True)
class _Status:
    """Numbers of the nodes that touch; which of these slide, and which way friction points."""

    touching: Index
    sliding: Mask
    direction: Array
    damping: Array


@dataclass(frozen=True)
class _Unknowns:
    """Components of force that a Newton step solves for, and the equations that they meet.

    first: node i of the touching has the unknowns from first[i] to first[i + 1].
    test, trial: (m, 3) directions of the equations and of the unknowns.  diagonal: (m,) m/N.
    """

    first: Index
    owner: Index
    test: Array
    trial: Array
    diagonal: Array


def solve(
    problem: Problem,
    guess: Guess,
    offset: Array,
    load: Array | None,
    settings: ContactSettings,
) -> Solution:
    """Forces and places at the end of a step.

    offset: (k, 3) m, what the displacement holds beyond the linear model.
    load: (4,) force on the gel along x, y, z, N, and torque about z through the indenter's
    origin, N m, to be reached by moving from the guessed pose; None keeps that pose.  Without
    friction only z is moved, and the rest of the load does not count.
    Raises NotConvergedError.
    """
    rest = problem.rest + offset
    view = _look(problem, rest, guess.force, guess.pose)
    status = _first_status(view, guess)
    residual = np.inf
    for iteration in range(settings.iterations):
        force, pose = _newton_step(problem, rest, view, status, load)
        if load is not None and way_between(guess.pose, pose) > LONGEST_WAY * settings.step:
            raise NotConvergedError(np.inf)
        share = 1.0 if iteration < settings.iterations // 2 else 0.5
        force = view.force + share * (force - view.force)
        if not np.isfinite(force).all():
            raise NotConvergedError(np.inf)
        view = _look(problem, rest, force, pose)
        residual = _residual(problem, view)
        missed = _missed_load(problem, view, load)
        if residual < settings.tolerance and missed < settings.load_tolerance:
            return _finished(problem, rest, view, residual)
        status = _status(problem, view)
    raise NotConvergedError(residual)


def _look(problem: Problem, rest: Array, force: Array, pose: Pose) -> _View:
    place = rest + problem.moved(force)
    gap, normal = problem.indenter.distance(pose.to_indenter(place))
    normal = normal @ pose.rotation.T
    pressing = (force * normal).sum(axis=1)
    slip = place - _anchors(problem, pose)
    return _View(
        force=force,
        pose=pose,
        place=place,
        gap=gap,
        normal=normal,
        slip=slip - (slip * normal).sum(axis=1)[:, None] * normal,
        pressing=pressing,
        along=force - pressing[:, None] * normal,
    )


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
    free = np.where(end < 0, start / np.where(closing > 0, closing, 1.0), 1.0)
    free = np.clip(free, 0.0, 1.0)[:, None]
    carried[new] += free * (before - carried[new])
    return carried


def _residual(problem: Problem, view: _View) -> float:
    """Largest distance from the contact laws, m."""
    own = problem.own
    gap = np.minimum(view.gap, own * view.pressing)
    trial = own[:, None] * view.along - view.slip
    limit = problem.friction * own * np.maximum(view.pressing, 0.0)
    size = np.linalg.norm(trial, axis=1)
    kept = np.minimum(1.0, limit / np.maximum(size, 1e-300))
    along = own[:, None] * view.along - kept[:, None] * trial
    along[view.pressing <= 0] = 0.0
    return float(max(np.abs(gap).max(), np.abs(along).max()))


def _missed_load(problem: Problem, view: _View, load: Array | None) -> float:
    """Largest miss of the load relative to its normal force."""
    if load is None:
        return 0.0
    found = np.einsum("kic,ki->c", _rigid(view), view.force)
    miss = _driven(problem) * (found - load) * (1.0, 1.0, 1.0, 1.0 / TURN_ARM)
    return float(np.abs(miss).max() / abs(load[2]))


def _driven(problem: Problem) -> Array:
    """Which of the motions in x, y, z and turn meet a load: 1 or 0, (4,)."""
    return np.ones(4) if problem.friction > 0 else np.array([0.0, 0.0, 1.0, 0.0])


def _rigid(view: _View) -> Array:
    """Velocity (k, 3, 4) of the indenter at the nodes, for its motion in x, y, z and turn."""
    rigid = np.zeros((len(view.place), 3, 4))
    rigid[:, [0, 1, 2], [0, 1, 2]] = 1.0
    arm = view.place - view.pose.position
    rigid[:, 0, 3], rigid[:, 1, 3] = -arm[:, 1], arm[:, 0]
    return rigid


def _first_status(view: _View, guess: Guess) -> _Status:
    """Nodes stay as they were; those that the moved indenter reaches stick at first."""
    touching = np.flatnonzero((view.pressing > 0) | (view.gap < 0))
    size = np.linalg.norm(view.along[touching], axis=1)
    sliding = guess.sliding[touching] & (size > 0)
    direction = view.along[touching] / np.where(size > 0, size, 1.0)[:, None]
    return _Status(touching, sliding, direction, np.zeros(len(touching)))


def _status(problem: Problem, view: _View) -> _Status:
    own = problem.own
    touching = np.flatnonzero(own * view.pressing > view.gap)
    own = own[touching]
    trial = view.along[touching] - view.slip[touching] / own[:, None]
    size = np.linalg.norm(trial, axis=1)
    limit = problem.friction * np.maximum(view.pressing[touching], 0.0)
    sliding = size > limit
    size = np.where(size > 0, size, 1.0)
    # The derivative of a direction: how much a force across it counts against a slip across it.
    blend = np.clip(limit / size, 1e-3, 1.0)
    return _Status(touching, sliding, trial / size[:, None], own * (1 - blend) / blend)


def _unknowns(problem: Problem, view: _View, status: _Status) -> _Unknowns:
    normal, count = view.normal[status.touching], len(status.touching)
    if problem.friction == 0:
        first = np.arange(count + 1)
        return _Unknowns(first, first[:-1], normal, normal, np.zeros(count))
    side = np.where(np.abs(normal[:, :1]) < 0.6, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    across = np.cross(normal, np.where(status.sliding[:, None], status.direction, side))
    across /= np.linalg.norm(across, axis=1)[:, None]
    first = np.concatenate([[0], np.cumsum(np.where(status.sliding, 2, 3))])
    test = np.empty((first[-1], 3))
    trial = np.empty((first[-1], 3))
    diagonal = np.zeros(first[-1])
    begin, sticks = first[:-1], ~status.sliding
    test[begin] = normal
    trial[begin] = normal
    trial[begin[status.sliding]] += problem.friction * status.direction[status.sliding]
    test[begin + 1] = trial[begin + 1] = across
    diagonal[begin[status.sliding] + 1] = status.damping[status.sliding]
    test[begin[sticks] + 2] = trial[begin[sticks] + 2] = np.cross(across, normal)[sticks]
    return _Unknowns(first, np.repeat(np.arange(count), np.diff(first)), test, trial, diagonal)


def _newton_step(
    problem: Problem, rest: Array, view: _View, status: _Status, load: Array | None
) -> tuple[Array, Pose]:
    """Forces and pose that meet the linearised laws, for given open, sticking, sliding nodes."""
    touching = status.touching
    if len(touching) == 0:
        return np.zeros_like(view.force), view.pose
    unknowns = _unknowns(problem, view, status)
    start = _admissible(problem, view, status, unknowns)
    place = rest + problem.moved(start)
    missing = _missing(view, status, unknowns, place, start)
    matrix = condensed_system(
        problem.compliance, problem.nodes[touching], unknowns.first, unknowns.test, unknowns.trial
    )
    matrix.ravel()[:: len(matrix) + 1] += unknowns.diagonal.astype(np.float32)
    rigid = _rigid(view)[touching]
    rigid *= _driven(problem)
    rigid[..., 3] /= TURN_ARM
    moves = np.einsum("mi,mic->mc", unknowns.test, rigid[unknowns.owner])
    columns = np.concatenate([missing[:, None], moves], axis=1)
    try:
        factors = lu_factor(matrix, overwrite_a=True, check_finite=False)
    except LinAlgError:
        raise NotConvergedError(np.inf) from None
    solved = lu_solve(factors, columns.astype(np.float32), check_finite=False).astype(np.float64)
    change, pose = -solved[:, 0], view.pose
    if load is not None:
        motion = _motion(unknowns, rigid, start[touching], solved, load)
        change = change + solved[:, 1:] @ motion
        pose = _moved_pose(pose, motion)
    parts = change[:, None] * unknowns.trial
    np.add.at(start, touching[unknowns.owner], parts)
    return start, pose


def _admissible(problem: Problem, view: _View, status: _Status, unknowns: _Unknowns) -> Array:
    """The forces nearest to the present ones that the unknowns can make up."""
    force = np.zeros_like(view.force)
    touching = status.touching
    force[touching] = view.force[touching]
    if problem.friction == 0:
        force[touching] = view.pressing[touching, None] * view.normal[touching]
        return force
    slides = touching[status.sliding]
    begin = unknowns.first[:-1][status.sliding]
    across = unknowns.test[begin + 1]
    pressing = np.maximum(view.pressing[slides], 0.0)[:, None]
    kept = (view.force[slides] * across).sum(axis=1)[:, None]
    force[slides] = pressing * unknowns.trial[begin] + kept * across
    return force


def _missing(
    view: _View,
    status: _Status,
    unknowns: _Unknowns,
    place: Array,
    force: Array,
) -> Array:
    """What the equations (m,) miss, m, at the places that the starting forces make."""
    touching, owner = status.touching, unknowns.owner
    anchor = view.place - view.slip
    missing = ((place - anchor)[touching][owner] * unknowns.test).sum(axis=1)
    begin = unknowns.first[:-1]
    moved = ((place - view.place)[touching] * unknowns.test[begin]).sum(axis=1)
    missing[begin] = view.gap[touching] + moved
    missing += unknowns.diagonal * (force[touching][owner] * unknowns.trial).sum(axis=1)
    return np.asarray(missing)


def _motion(unknowns: _Unknowns, rigid: Array, force: Array, solved: Array, load: Array) -> Array:
    """How far the indenter moves, (4,) m, the turn times TURN_ARM, to meet the load."""
    found = np.einsum("kic,ki->c", rigid, force)
    weights = np.einsum("mi,mic->mc", unknowns.trial, rigid[unknowns.owner])
    found = found - weights.T @ solved[:, 0]
    stiffness = weights.T @ solved[:, 1:]
    wanted = load * (1.0, 1.0, 1.0, 1.0 / TURN_ARM)
    return np.asarray(np.linalg.pinv(stiffness, rcond=SOFTEST) @ (wanted - found))


def _moved_pose(pose: Pose, motion: Array) -> Pose:
    turn = Rotation.from_rotvec([0.0, 0.0, motion[3] / TURN_ARM]).as_matrix()
    return Pose(pose.position + motion[:3], turn @ pose.rotation)


def way_between(begin: Pose, end: Pose) -> float:
    """How far a motion takes the points of a contact about, m."""
    turn = Rotation.from_matrix(end.rotation @ begin.rotation.T).magnitude()
    return float(np.linalg.norm(end.position - begin.position) + TURN_ARM * turn)


def _finished(problem: Problem, rest: Array, view: _View, residual: float) -> Solution:
    """Forces put exactly on the cone; a node at its edge slides."""
    for _ in range(20):
        pressing = np.where(view.pressing > view.gap / problem.own, view.pressing, 0.0)
        limit = problem.friction * np.maximum(pressing, 0.0)
        size = np.linalg.norm(view.along, axis=1)
        kept = np.minimum(1.0, limit / np.maximum(size, 1e-300))
        force = np.maximum(pressing, 0.0)[:, None] * view.normal + kept[:, None] * view.along
        change = np.abs(force - view.force).max()
        view = _look(problem, rest, force, view.pose)
        if change <= 1e-13 * np.abs(force).max():
            break
    size = np.linalg.norm(view.along, axis=1)
    sliding = (view.pressing > 0) & (size >= (1 - 1e-6) * problem.friction * view.pressing)
    return Solution(view.force, view.pose, view.place, sliding, residual)
