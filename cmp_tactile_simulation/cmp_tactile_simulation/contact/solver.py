"""Frictional contact of a rigid indenter on the condensed compliance of a gel.

Signorini's and Coulomb's laws at all nodes are one non-smooth equation (Alart and Curnier 1991),
solved by Newton's method: each iteration knows which nodes are open, which stick and which
slide, takes normals and gaps at the nodes' latest places, and solves for the rest.  The same
system holds the indenter's motion where the load is given instead of the place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import sgesv
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.errors import NotConvergedError
from cmp_tactile_simulation.contact import laws
from cmp_tactile_simulation.contact.laws import Pose

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

# Longest way of any point of the indenter's contact in one step, m.
LONGEST_STEP = 2e-4
# How far gap and slip may miss their conditions, m: where the iteration ends early, and at all.
TOLERANCE, ACCEPTED = 1e-10, 5e-8
# How far a node that can neither stick nor slide may creep in one step, m.
FLIP_TOLERANCE = 1e-6
# How far a load may be missed, relative to the normal force.
LOAD_TOLERANCE = 1e-6
# Newton iterations of one step.
ITERATIONS = 30
# Length that makes a torque comparable with a force, m: how far a fingertip's contact reaches.
CONTACT_ARM = 2e-3
# Motions of the indenter that a load drives: along x, y, z and about z.
DRIVEN = [0, 1, 2, 5]
# Directions in which the contact is this much softer than in its stiffest are not driven.
SOFTEST = 1e-6
# Where a force moves its own node so far that the normal turns by more than this, rad, the
# turning is part of the system; elsewhere the iteration takes care of it, with fewer unknowns.
SLIGHT_TURN = 0.01
# Beyond 1 a node on an edge has no stable place there and slides off.  Newton's method would
# step towards the unstable place; with less turning in the system it steps away, as the node does.
MOST_TURN = 0.9
# A node that came back from sliding to sticking this often is opened.
MOST_RETURNS = 2

# A step under load that needs more than this many times the longest step is cut short.
LONGEST_WAY = 4.0
# Solved forces are put on the cone until they change by less than this share.
CONE_TOLERANCE = 1e-13
CONE_PASSES = 60
# While friction exceeds the cone by more than this share of the largest force, the iteration
# goes on.
CONE_EXCESS = 1e-10
# A node whose friction is this near to the cone slides.
EDGE_SHARE = 1e-6


@dataclass(frozen=True)
class Status:
    """The nodes that touch (numbers), and for each of these (k):

    sliding; direction (k, 3) of friction; blend 0..1: how much a slip across that direction
    counts against a force across it, the derivative of a unit vector.
    """

    touching: Index
    sliding: Mask
    direction: Array
    blend: Array


@dataclass(frozen=True)
class _System:
    """Equations test . moved + local . force + missing = 0 for the touching nodes.

    Node i has the unknowns and equations first[i] to first[i + 1], `owner` is the node of each;
    force changes by multiples of trial (m, 3).  start: (k, 3) N forces that they begin with.
    """

    first: Index
    owner: Index
    trial: Array
    test: Array
    local: Array
    missing: Array
    start: Array


class Flips:
    """Frees or holds nodes that can neither stick nor slide where they are.

    Where the surface is steep, a node that sticks may be pulled beyond the cone although, once
    it slides, it is pushed back.  In the real gel it jumps: off the indenter, if it finds no
    force there, and if not, to a place farther along.  A node that keeps coming back to
    sticking is therefore opened once, and then held on the cone, on which it creeps on until
    Coulomb's law has an answer again.
    """

    def __init__(self, count: int) -> None:
        self._slid = np.zeros(count, dtype=bool)
        self._returns = np.zeros(count, dtype=np.intp)

    @property
    def held(self) -> Mask:
        """Nodes that are held, (k,)."""
        return self._returns > MOST_RETURNS

    def hold(self, status: Status) -> Status:
        """The status with nodes opened and held."""
        touching = status.touching
        slides, sticks = np.zeros_like(self._slid), np.zeros_like(self._slid)
        slides[touching], sticks[touching] = status.sliding, ~status.sliding
        returned = self._slid & sticks
        self._returns += returned
        self._slid = (self._slid | slides) & ~sticks
        kept = ~(returned & (self._returns == MOST_RETURNS))[touching]
        return Status(
            touching=touching[kept],
            sliding=(status.sliding | self.held[touching])[kept],
            direction=status.direction[kept],
            blend=status.blend[kept],
        )


def first_status(problem: laws.Problem, view: laws.View, sliding: Mask) -> Status:
    """Nodes stay as they were; those that the moved indenter reaches stick at first."""
    touching = np.flatnonzero((view.pressing > 0) | (view.gap < 0))
    along = view.along[touching]
    size = np.linalg.norm(along, axis=1)
    slides = (sliding[touching] & (size > 0)) | (problem.friction == 0)
    blend = np.full(len(touching), float(problem.friction > 0))
    return Status(touching, slides, _directions(view, touching, along), blend)


def status_of(problem: laws.Problem, view: laws.View) -> Status:
    """What each node does according to the laws, seen from a state that may not obey them yet."""
    own = problem.own
    touching = np.flatnonzero(own * view.pressing > view.gap)
    trial = view.along[touching] - view.slip[touching] / own[touching][:, None]
    size = np.linalg.norm(trial, axis=1)
    limit = problem.friction * np.maximum(view.pressing[touching], 0.0)
    sliding = (size > limit) | (problem.friction == 0)
    blend = np.clip(limit / np.where(size > 0, size, 1.0), 0.0, 1.0)
    return Status(touching, sliding, _directions(view, touching, trial), blend)


def newton_step(
    problem: laws.Problem, view: laws.View, status: Status, load: Array | None
) -> tuple[Array, Pose]:
    """Forces (k, 3) N and pose that meet the linearised laws for a given status."""
    touching = status.touching
    force = np.zeros_like(view.force)
    if len(touching) == 0:
        return force, view.pose
    system = _system(problem, view, status)
    force[touching] = system.start
    moved = problem.moved(force - view.force)[touching]
    missing = system.missing + (system.test * moved[system.owner]).sum(axis=1)
    rigid = _rigid(view)[touching][..., DRIVEN] * _driven(problem)
    rigid[..., 3] /= CONTACT_ARM
    moves = np.einsum("mi,mic->mc", system.test, rigid[system.owner])
    solved = _solved(problem, touching, system, np.column_stack([missing, moves]))
    change, pose = -solved[:, 0], view.pose
    if load is not None:
        motion = _motion(system, rigid, solved, load)
        change = change + solved[:, 1:] @ motion
        turn = Rotation.from_rotvec([0.0, 0.0, motion[3] / CONTACT_ARM]).as_matrix()
        pose = Pose(pose.position + motion[:3], turn @ pose.rotation)
    np.add.at(force, touching[system.owner], change[:, None] * system.trial)
    return force, pose


def missed_load(problem: laws.Problem, view: laws.View, load: Array | None) -> float:
    """Largest miss of the load relative to its normal force."""
    if load is None:
        return 0.0
    found = np.einsum("kic,ki->c", _rigid(view)[..., DRIVEN], view.force)
    miss = _driven(problem) * (found - load) * (1.0, 1.0, 1.0, 1.0 / CONTACT_ARM)
    return float(np.abs(miss).max() / abs(load[2]))


def _directions(view: laws.View, touching: Index, vectors: Array) -> Array:
    """Unit vectors along vectors (k, 3) that lie along the surface; any where these are zero."""
    size = np.linalg.norm(vectors, axis=1)[:, None]
    otherwise, _ = laws.tangents(view.normal[touching])
    return np.where(size > 0, vectors / np.where(size > 0, size, 1.0), otherwise)


def _system(problem: laws.Problem, view: laws.View, status: Status) -> _System:
    """Two or three equations and unknowns a node: gap, and slip or friction in two directions.

    Where the normal turns little, a sliding node's friction follows its normal force, which
    leaves that force and, with friction, a force across the slip as unknowns.
    """
    touching, slides = status.touching, status.sliding
    own, force = problem.own[touching], view.force[touching]
    normal, along = view.normal[touching], status.direction
    across = laws.crossed(normal, along)
    pressing = np.maximum(view.pressing[touching], 0.0)
    bend, curved = _bend(problem, view, status)
    flat = slides & ~curved
    mu = problem.friction

    # Rows of a node: gap; friction along the slip, or no slip; the mix of both across it.
    test, local, trial = (np.zeros((len(touching), 3, 3)) for _ in range(3))
    test[:, 0], trial[:] = normal, np.stack([normal, along, across], axis=1)
    test[:, 1] = np.where(
        slides[:, None],
        -(1 + mu**2) * own[:, None] * np.einsum("kij,kj->ki", bend, along),
        along,
    )
    local[:, 1] = np.where(slides[:, None], own[:, None] * (along - mu * normal), 0.0)
    blend = np.where(slides, status.blend, 1.0)[:, None]
    rest = (1 - blend) * own[:, None]
    test[:, 2] = blend * across - rest * np.einsum("kij,kj->ki", bend, across)
    local[:, 2] = rest * across
    slip = view.slip[touching][:, None, :]
    missing = (local * force[:, None]).sum(axis=2)
    missing[:, 0] += view.gap[touching]
    missing[:, 1] += np.where(slides, 0.0, (slip[:, 0] * along).sum(axis=1))
    missing[:, 2] += blend[:, 0] * (slip[:, 0] * across).sum(axis=1)

    # A flat sliding node starts on the cone and stays there.
    trial[flat, 0] += mu * along[flat]
    start = force.copy()
    kept = (force * across).sum(axis=1) * (mu > 0)
    start[flat] = pressing[flat, None] * trial[flat, 0] + (kept[:, None] * across)[flat]
    missing += (local * (start - force)[:, None]).sum(axis=2)
    used = np.ones((len(touching), 3), dtype=bool)
    used[flat, 1] = False
    used[flat, 2] = mu > 0
    counts = used.sum(axis=1)
    return _System(
        first=np.concatenate([[0], np.cumsum(counts)]),
        owner=np.repeat(np.arange(len(touching)), counts),
        trial=trial[used],
        test=test[used],
        local=local[used],
        missing=missing[used],
        start=start,
    )


def _bend(problem: laws.Problem, view: laws.View, status: Status) -> tuple[Array, Mask]:
    """How much the normal forces of sliding nodes (k, 3, 3) turn with their places, N/m; and which
    nodes turn more than slightly.
    """
    bend = np.zeros((len(status.touching), 3, 3))
    slides = np.flatnonzero(status.sliding)
    nodes, most = status.touching[slides], MOST_TURN / (1 + problem.friction**2)
    pressing = np.maximum(view.pressing[nodes], 0.0)
    bend[slides] = pressing[:, None, None] * laws.curvature(problem, view, nodes)
    turn = problem.own[nodes] * np.linalg.eigvalsh(bend[slides])[:, [0, -1]].T
    bend[slides] *= np.minimum(1.0, most / np.maximum(turn[1], most))[:, None, None]
    curved = np.zeros_like(status.sliding)
    curved[slides] = np.abs(turn).max(axis=0) > SLIGHT_TURN
    return bend, curved


def _solved(problem: laws.Problem, touching: Index, system: _System, columns: Array) -> Array:
    """The system's answer (m, c) to the columns, as displacements, in single precision."""
    first, nodes = system.first, problem.nodes[touching]
    matrix = laws.condensed_system(
        problem.compliance, nodes, first, system.test, system.trial, system.local
    )
    _, _, solved, singular = sgesv(matrix, columns.astype(np.float32), overwrite_a=True)
    if singular or not np.isfinite(solved).all():
        raise NotConvergedError
    return np.asarray(solved, dtype=np.float64)


def _motion(system: _System, rigid: Array, solved: Array, load: Array) -> Array:
    """How far the indenter moves, (4,) m, the turn times CONTACT_ARM, to meet the load."""
    weights = np.einsum("mi,mic->mc", system.trial, rigid[system.owner])
    found = np.einsum("kic,ki->c", rigid, system.start) - weights.T @ solved[:, 0]
    stiffness = weights.T @ solved[:, 1:]
    wanted = load * (1.0, 1.0, 1.0, 1.0 / CONTACT_ARM)
    return np.asarray(np.linalg.pinv(stiffness, rcond=SOFTEST) @ (wanted - found))


def stiffness(problem: laws.Problem, offset: Array, state: Guess) -> Array:
    """How force and moment on the gel change as the indenter moves, (6, 6) N, N m per m, rad.

    Both are about the indenter's origin, rows and columns along and about x, y, z.
    offset: see solve.  state: solved, of the nodes that touch.  What sticks and what slides goes on
    to; a motion that ends that changes the force less.
    """
    view = laws.look(problem, problem.rest + offset, state.force, state.pose)
    nodes = np.arange(len(view.force))
    along = _directions(view, nodes, view.along)
    system = _system(problem, view, Status(nodes, state.sliding, along, np.ones(len(nodes))))
    rigid = _rigid(view)
    # In the solver's single precision, turns count as the ways that they make.
    rigid[..., 3:] /= CONTACT_ARM
    moves = np.einsum("mi,mic->mc", system.test, rigid[system.owner])
    weights = np.einsum("mi,mic->mc", system.trial, rigid[system.owner])
    scale = np.array([1.0, 1.0, 1.0, CONTACT_ARM, CONTACT_ARM, CONTACT_ARM])
    return np.asarray(weights.T @ _solved(problem, nodes, system, moves) * np.outer(scale, scale))


def _rigid(view: laws.View) -> Array:
    """Velocity (k, 3, 6) of the indenter at the nodes, for its motion along and about x, y, z."""
    rigid = np.zeros((len(view.place), 3, 6))
    rigid[:, [0, 1, 2], [0, 1, 2]] = 1.0
    arm = view.place - view.pose.position
    # The axis times the arm.
    rigid[:, [2, 0, 1], [3, 4, 5]] = arm[:, [1, 2, 0]]
    rigid[:, [1, 2, 0], [3, 4, 5]] = -arm[:, [2, 0, 1]]
    return rigid


def _driven(problem: laws.Problem) -> Array:
    """Which of the motions in x, y, z and turn meet a load: 1 or 0, (4,)."""
    return np.ones(4) if problem.friction > 0 else np.array([0.0, 0.0, 1.0, 0.0])


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


def solve(
    problem: laws.Problem,
    guess: Guess,
    offset: Array,
    load: Array | None,
    accepted: float = ACCEPTED,
) -> Solution:
    """Forces and places at the end of a step.

    offset: (k, 3) m, what the displacement holds beyond the linear model.
    load: (4,) force on the gel along x, y, z, N, and torque about z through the indenter's
    origin, N m, to be reached by moving from the guessed pose; None keeps that pose.  Without
    friction only z is moved, and the rest of the load does not count.
    accepted: how far gap and slip may miss their conditions in the end, m.
    Raises NotConvergedError.
    """
    rest = problem.rest + offset
    view = laws.look(problem, rest, guess.force, guess.pose)
    status = first_status(problem, view, guess.sliding)
    flips = Flips(len(rest))
    best, residual = view, np.inf
    for iteration in range(ITERATIONS):
        force, pose = newton_step(problem, view, status, load)
        if load is not None and way_between(guess.pose, pose) > LONGEST_WAY * LONGEST_STEP:
            raise NotConvergedError
        if iteration >= ITERATIONS // 2:
            force = (view.force + force) / 2
        view = laws.look(problem, rest, force, pose, view)
        found = _residual(problem, view, flips)
        if found < residual and missed_load(problem, view, load) < LOAD_TOLERANCE:
            best, residual = view, found
            if residual < TOLERANCE:
                polished = _polished(problem, rest, view)
                if _excess(problem, polished) < CONE_EXCESS:
                    return _finished(problem, polished, accepted)
        status = flips.hold(status_of(problem, view))
    if residual > accepted:
        raise NotConvergedError(residual=residual)
    return _finished(problem, _polished(problem, rest, best), accepted)


def _residual(problem: laws.Problem, view: laws.View, flips: Flips) -> float:
    """Largest distance from the laws, m, but for nodes that are held."""
    signorini, coulomb = laws.law_residual(problem, view)
    coulomb[flips.held & (coulomb < FLIP_TOLERANCE)] = 0.0
    return float(max(signorini.max(), coulomb.max()))


def way_between(begin: Pose, end: Pose) -> float:
    """How far a motion takes the points of a contact about, m."""
    way = float(np.linalg.norm(end.position - begin.position))
    return way + CONTACT_ARM * begin.turn_to(end)


def _polished(problem: laws.Problem, rest: Array, view: laws.View) -> laws.View:
    """The view with its forces put on the cone, as nearly as what that moves allows."""
    change = np.inf
    for _ in range(CONE_PASSES):
        force = laws.on_cone(problem, view)
        before, change = change, float(np.abs(force - view.force).max())
        # On an edge without a stable place the passes would lead away from the solution.
        if change > before:
            break
        view = laws.look(problem, rest, force, view.pose, view)
        if change <= CONE_TOLERANCE * np.abs(force).max():
            break
    return view


def _excess(problem: laws.Problem, view: laws.View) -> float:
    """How far friction exceeds the cone, as a share of the largest normal force."""
    beyond = np.linalg.norm(view.along, axis=1) - problem.friction * view.pressing
    return float(beyond.max(initial=0.0) / max(view.pressing.max(initial=0.0), laws.TINY))


def _finished(problem: laws.Problem, view: laws.View, accepted: float) -> Solution:
    residual = float(max(part.max() for part in laws.law_residual(problem, view)))
    if residual > max(accepted, FLIP_TOLERANCE):
        raise NotConvergedError(residual=residual)
    size = np.linalg.norm(view.along, axis=1)
    edge = (1 - EDGE_SHARE) * problem.friction * view.pressing
    return Solution(view.force, view.pose, view.place, (view.pressing > 0) & (size >= edge))
