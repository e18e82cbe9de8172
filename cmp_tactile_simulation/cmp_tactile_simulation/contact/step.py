"""One step of a contact: which nodes may touch, what the gel really does, and whether it holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cmp_tactile_processing.cache.threads import one_thread
from cmp_tactile_processing.errors import ContactError, NotConvergedError
from cmp_tactile_simulation.contact import solver
from cmp_tactile_simulation.contact.laws import ContactState, Pose, Problem, bulge
from cmp_tactile_simulation.indenters import Indenter
from cmp_tactile_simulation.neo_hookean_gel import Elastomer

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Nodes nearer to the indenter than this many steps may come to touch in the next one.
NEAR_STEPS = 1.5
# The compliance is fetched for nodes up to this many times farther away, to be fetched rarely.
FETCHED_RATIO = 4.0
# How far the solver's displacement may differ from a non-linear gel's, m, and passes in which it is
# corrected.
DEFECT, CORRECTIONS = 5e-8, 40
# A non-linear gel is asked for its compliance again where a correction leaves more than this share.
GOOD_CORRECTION = 0.1


class ContactStep:
    """Solves steps between an elastomer and an indenter, each from a solved state.

    accepted: how far gap and slip may miss their conditions, m.
    """

    def __init__(
        self,
        elastomer: Elastomer,
        indenter: Indenter,
        friction: float,
        accepted: float = solver.ACCEPTED,
    ) -> None:
        self.elastomer, self.indenter = elastomer, indenter
        self.friction, self._accepted = friction, accepted
        self._changing = elastomer.softens
        self._creeps = elastomer.creeps
        self._rest, self._beyond = elastomer.node_position, elastomer.beyond
        self._on_rim = elastomer.on_rim
        self._sag = _sag_of_hats(elastomer)
        self._nearest = _nearest(self._beyond, self._rest, np.flatnonzero(self._on_rim))
        self._forget()

    def _forget(self) -> None:
        self._held: Index = np.zeros(0, dtype=np.intp)
        self._compliance: Array = np.zeros((0, 0))

    def gap(self, pose: Pose, displacement: Array) -> Array:
        """Distance (N,) m from the displaced nodes to the indenter."""
        place = self._rest + displacement
        return self.indenter.distance(pose.to_indenter(place))[0]

    def _bulge(self, pose: Pose, displacement: Array) -> Array:
        """By how much the mean gap over a node's hat is more than `gap`, (N,) m.

        A step takes it from the state that it begins with, because it jumps where an edge's
        rounding begins.
        """
        place, spacing = self._rest + displacement, self.elastomer.nodes.spacing
        return bulge(self.indenter, pose, place, spacing) + self._sag

    def free(self, pose: Pose) -> ContactState:
        """The gel without forces, the indenter elsewhere; whether nodes are free is not looked at.

        Raises ContactError where the indenter is in the gel outside the contact patch.
        """
        force, moved = np.zeros_like(self._rest), self._unloaded()
        self._refuse_outside(pose, moved)
        none = np.zeros(len(force), dtype=bool)
        gap = self.gap(pose, moved) + self._bulge(pose, moved)
        return ContactState(pose, force, moved, gap, none, none)

    def _unloaded(self) -> Array:
        """Displacement without forces, (N, 3) m: that of a gel that creeps takes time to fade."""
        nothing = np.zeros_like(self._rest)
        return self._displacement(nothing) if self._creeps else nothing

    def __call__(self, state: ContactState, pose: Pose, load: Array | None = None) -> ContactState:
        """The state after a short motion to `pose`, or, from there, to where `load` is reached.

        load: see solver.solve.
        Raises NotConvergedError, and ContactError where the contact leaves its patch.
        """
        # Threads of BLAS that wait for each other cost ten times more than they save on matrices
        # as small as these, once another process has a core.
        with one_thread():
            if self._changing:
                # What an earlier step fetched is no part of the state.
                self._forget()
            return self._reach(state, pose, load)

    def stiffness(self, state: ContactState) -> Array:
        """See solver.stiffness; zeros where nothing touches."""
        nodes = np.flatnonzero(state.contact)
        if len(nodes) == 0:
            return np.zeros((6, 6))
        with one_thread():
            # How far away the indenter is does not matter.
            problem = self._problem(state, nodes, np.zeros(len(self._rest)))
            offset = state.displacement[nodes] - problem.moved(state.force[nodes])
            guess = solver.Guess(state.force[nodes], state.pose, state.slipping[nodes])
            return solver.stiffness(problem, offset, guess)

    def _reach(self, state: ContactState, pose: Pose, load: Array | None) -> ContactState:
        free = not state.contact.any() and load is None
        moved = self._unloaded() if free and self._creeps else state.displacement
        beyond_node = self._bulge(state.pose, state.displacement)
        gap = self.gap(pose, moved) + beyond_node
        if free and gap.min() >= 0:
            return self.free(pose)
        nearest = np.minimum(gap, state.gap)
        near = nearest < NEAR_STEPS * solver.LONGEST_STEP
        nodes = np.flatnonzero(near | state.contact)
        while True:
            reached = self._solved(state, pose, load, nodes, beyond_node)
            reached = replace(reached, gap=reached.gap + beyond_node)
            lost = np.flatnonzero(reached.gap < -self._accepted)
            lost = np.setdiff1d(lost, nodes)
            if len(lost) == 0:
                break
            nodes = np.union1d(nodes, lost)
        self._refuse_rim(reached)
        self._refuse_outside(reached.pose, reached.displacement)
        return reached

    def _solved(
        self, state: ContactState, pose: Pose, load: Array | None, nodes: Index, beyond_node: Array
    ) -> ContactState:
        """Solve for some nodes until the gel's true displacement is what the solver thinks."""
        problem = self._problem(state, nodes, beyond_node)
        offset = state.displacement[nodes] - problem.moved(state.force[nodes])
        guess = solver.Guess(state.force[nodes], pose, state.slipping[nodes])
        defect = before = np.inf
        for _ in range(CORRECTIONS):
            solution = solver.solve(problem, guess, offset, load, self._accepted)
            force = np.zeros_like(state.force)
            force[nodes] = solution.force
            displacement = self._displacement(force)
            missed = problem.rest + displacement[nodes] - solution.place
            defect = float(np.abs(missed).max(initial=0.0))
            if defect < DEFECT:
                return self._state(solution, nodes, force, displacement)
            if defect > GOOD_CORRECTION * before:
                self._hold(nodes, state)
                problem = self._problem(state, nodes, beyond_node)
                offset = displacement[nodes] - problem.moved(solution.force)
            else:
                offset = offset + missed
            before = defect
            guess = solver.Guess(solution.force, solution.pose, solution.sliding)
        raise NotConvergedError(residual=defect)

    def _problem(self, state: ContactState, nodes: Index, beyond_node: Array) -> Problem:
        if not np.isin(nodes, self._held, assume_unique=True).all():
            self._hold(nodes, state)
        rest = self._rest[nodes]
        return Problem(
            compliance=self._compliance,
            nodes=np.searchsorted(self._held, nodes),
            rest=rest,
            before=rest + state.displacement[nodes],
            before_pose=state.pose,
            touched=state.contact[nodes],
            bulge=beyond_node[nodes],
            indenter=self.indenter,
            friction=self.friction,
        )

    def _hold(self, nodes: Index, state: ContactState) -> None:
        """Fetch the compliance of these nodes and, unless it changes, of those needed soon."""
        soon = np.flatnonzero(state.gap < FETCHED_RATIO * NEAR_STEPS * solver.LONGEST_STEP)
        later = np.union1d(np.union1d(self._held, nodes), soon)
        self._held = nodes if self._changing else later
        self._compliance = self.elastomer.compliance(self._held)

    def _displacement(self, force: Array) -> Array:
        try:
            displacement = self.elastomer.displacement(force)
        except ContactError as error:
            raise NotConvergedError from error
        if not np.isfinite(displacement).all():
            raise NotConvergedError
        return displacement

    def _state(
        self, solution: solver.Solution, nodes: Index, force: Array, displacement: Array
    ) -> ContactState:
        contact = np.asarray(force.any(axis=1))
        sliding = np.zeros(len(force), dtype=bool)
        sliding[nodes] = solution.sliding
        gap = self.gap(solution.pose, displacement)
        return ContactState(solution.pose, force, displacement, gap, contact, sliding & contact)

    def _refuse_rim(self, state: ContactState) -> None:
        touching = np.flatnonzero(state.contact & self._on_rim)
        if len(touching) > 0:
            raise self._out_of_patch("a contact at the rim", self._rest[touching[0]])

    def _refuse_outside(self, pose: Pose, displacement: Array) -> None:
        """The gel there is taken to move as the nearest node of the rim does."""
        place = self._beyond + displacement[self._nearest]
        gap, _ = self.indenter.distance(pose.to_indenter(place))
        if (gap < 0).any():
            deepest = self._beyond[gap.argmin()]
            raise self._out_of_patch("a contact outside", deepest)

    def _out_of_patch(self, what: str, place: Array) -> ContactError:
        x, y = 1e3 * place[:2]
        width, height = (1e3 * extent for extent in self.elastomer.nodes.extent)
        return ContactError(
            f"{self.indenter.name}: found {what} of the contact patch, at ({x:.2f}, {y:.2f}) mm, "
            f"expected a contact inside the patch of {width:.2f} x {height:.2f} mm"
        )


def _sag_of_hats(elastomer: Elastomer) -> Array:
    """By how much the surface at rest lies lower on the mean over a node's hat, (N,) m."""
    nodes = elastomer.nodes
    height = elastomer.node_position[:, 2].reshape(nodes.rows, nodes.cols)
    bend = [np.gradient(np.gradient(height, axis=axis), axis=axis) for axis in (0, 1)]
    return np.asarray(-(bend[0] + bend[1]).ravel() / 12)


def _nearest(points: Array, nodes: Array, among: Index) -> Index:
    """Numbers of the nodes, of those `among`, that lie nearest to points (M, 3)."""
    _, nearest = cKDTree(nodes[among]).query(points)
    return among[np.asarray(nearest, dtype=np.intp)]
