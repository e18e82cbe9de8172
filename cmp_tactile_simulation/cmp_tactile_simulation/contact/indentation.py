"""Contact between a rigid indenter and the gel, driven by place or by load, step by step."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.cache.threads import one_thread
from cmp_tactile_simulation.contact import solver
from cmp_tactile_simulation.contact.laws import ContactState, Load, Pose, Problem, bulge
from cmp_tactile_simulation.errors import ContactError, LoadError, MaterialError
from cmp_tactile_simulation.gel import Elastomer
from cmp_tactile_simulation.indenters import Indenter

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
LOGGER = logging.getLogger(__name__)
# No step need be shorter than this share of the longest: sharper edges than that are met by
# shortening steps that fail.
FINEST_STEP_SHARE = 0.125
# Share of the first step below which it is not shortened.
LEAST_STEP_SHARE = 1 / 64
# How far gap and slip may miss their conditions where no shorter step helps, m, the smaller one if
# that is enough, and the share to which a step is then shortened.
LAST_RESORTS, LAST_STEP_SHARE = (5e-6, 1e-5), 1 / 4096
# A place that touches may be inside by this much, m.
TOUCH_TOLERANCE = 1e-9
MAX_TOUCH_STEPS = 1000
# Where it touches is looked for in so many steps from node to node.
TOUCH_POINTS = 4
# Shares of a way are equal if they differ by less.
ROUNDING = 1e-9
# How far the indenter goes into the gel before it follows a load, of the longest step.
FIRST_DEPTH_SHARES = (0.1, 0.5, 1.0, 2.0)
# Share of the way to the load in the first step, and the shortest that is tried.
FIRST_SHARE, LEAST_SHARE = 0.02, 1e-3


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

    def _bulge(self, pose: Pose, displacement: Array, nodes: Index | slice = slice(None)) -> Array:
        """By how much the mean gap over a node's hat is more than `gap`, (k,) m of some nodes.

        A step takes it from the state that it begins with, because it jumps where an edge's
        rounding begins.
        """
        place, spacing = (self._rest + displacement)[nodes], self.elastomer.nodes.spacing
        return bulge(self.indenter, pose, place, spacing) + self._sag[nodes]

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
            reached = self._solved(state, pose, load, nodes)
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
        self, state: ContactState, pose: Pose, load: Array | None, nodes: Index
    ) -> ContactState:
        """Solve for some nodes until the gel's true displacement is what the solver thinks."""
        problem = self._problem(state, nodes)
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
                problem = self._problem(state, nodes)
                offset = displacement[nodes] - problem.moved(solution.force)
            else:
                offset = offset + missed
            before = defect
            guess = solver.Guess(solution.force, solution.pose, solution.sliding)
        raise solver.NotConvergedError(defect)

    def _problem(self, state: ContactState, nodes: Index) -> Problem:
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
            bulge=self._bulge(state.pose, state.displacement, nodes),
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
        except MaterialError as error:
            raise solver.NotConvergedError(np.inf) from error
        if not np.isfinite(displacement).all():
            raise solver.NotConvergedError(np.inf)
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


class ContactSimulation:
    """A rigid indenter with Coulomb friction on a gel.

    States are values: each call returns a new one and depends on nothing but its arguments and
    the elastomer's memory.
    friction: Coulomb's coefficient.
    """

    def __init__(
        self,
        elastomer: Elastomer,
        indenter: Indenter,
        friction: float,
    ) -> None:
        self.elastomer, self.indenter, self.friction = elastomer, indenter, float(friction)
        self._step = ContactStep(elastomer, indenter, self.friction)
        self._lenient_steps = [
            ContactStep(elastomer, indenter, self.friction, accepted) for accepted in LAST_RESORTS
        ]

    def rest(self, pose: Pose) -> ContactState:
        """The undeformed gel, with the indenter at a pose that does not reach into it.

        Raises ContactError with the depth and the place where it does.
        """
        state = self._step.free(pose)
        gap = self._step.gap(pose, state.displacement)
        deepest = int(gap.argmin())
        if gap[deepest] < -TOUCH_TOLERANCE:
            x, y, z = 1e3 * self.elastomer.node_position[deepest]
            msg = (
                f"{self.indenter.name}: found a start {-1e3 * gap[deepest]:.4g} mm inside the "
                f"gel, at ({x:.2f}, {y:.2f}, {z:.2f}) mm, expected outside or touching"
            )
            raise ContactError(msg)
        return state

    def move(self, state: ContactState, pose: Pose) -> ContactState:
        """The state after a straight motion at constant rates to `pose`, in steps short enough.

        A gel that creeps is solved again also where nothing moves.
        Raises ContactError where the contact leaves its patch or is not solved, MaterialError
        where the gel cannot follow.
        """
        begin, way = state.pose, self._way(state.pose, pose)
        if way == 0 and not self.elastomer.creeps:
            return state
        first = 1 / max(1.0, np.ceil(way / self._longest_step - ROUNDING))
        share, step = 0.0, first
        while share < 1:
            end = min(1.0, share + step)
            end = 1.0 if end > 1 - ROUNDING else end
            try:
                state = self._step(state, begin.towards(pose, end))
            except solver.NotConvergedError:
                step /= 2
                if step >= LEAST_STEP_SHARE * first:
                    continue
                ends = [min(1.0, share + length) for length in _last_steps(first)]
                state, end = self._moved_at_last(state, (begin, pose), ends)
            share, step = end, min(first, 2 * step)
        return state

    def press(self, state: ContactState, load: Load) -> ContactState:
        """The state in which the indenter presses with `load`, found by moving it.

        It moves along x, y and z and turns about z; its tilt is kept.  A normal force that grows
        is reached first, then tangential force and torque together; one that shrinks is reached
        last, so that friction carries what lies between wherever it carries the ends.  From
        above the gel the indenter first comes straight down.  Without friction it moves along z
        alone.
        Raises LoadError for a load that cannot be carried, with what was asked and reached.
        """
        check_load(load, self.friction)
        if load.normal == 0:
            return self.move(state, self.touch(state.pose))
        if state.contact.any():
            return follow_load(self._step, state, load)
        return self._press_from_above(self.move(state, self.touch(state.pose)), load)

    def load(self, state: ContactState) -> Load:
        """What the indenter presses with in a state."""
        return carried_load(self.elastomer, state)

    def driven_load(self, state: ContactState) -> Load:
        """What a further load starts from: `load`, of which only the normal force without friction.

        Without friction nothing drives the indenter sideways, and what the slope of the contact
        leaves there is not to be reached again.
        """
        load = self.load(state)
        return load if self.friction > 0 else Load(load.normal)

    def touch(self, pose: Pose) -> Pose:
        """The pose moved along z to where the indenter just touches the undeformed gel.

        It comes from above.  Raises ContactError where it meets no node of the contact patch.
        """
        surface = _between_nodes(self.elastomer)
        z = float(surface[:, 2].max()) + self.indenter.reach
        lowest = float(surface[:, 2].min()) - self.indenter.reach
        for _ in range(MAX_TOUCH_STEPS):
            here = Pose(np.array([*pose.position[:2], z]), pose.rotation)
            gap = float(self.indenter.distance(here.to_indenter(surface))[0].min())
            if gap < TOUCH_TOLERANCE:
                return here
            z -= gap
            if z < lowest:
                break
        x, y = 1e3 * pose.position[:2]
        msg = (
            f"{self.indenter.name}: found no contact below ({x:.2f}, {y:.2f}) mm, expected a "
            f"place above the contact patch of {_size_mm(self.elastomer)} mm"
        )
        raise ContactError(msg)

    def _press_from_above(
        self, touching: ContactState, load: Load, attempt: int = 0
    ) -> ContactState:
        """Go in by a little, and farther where so few nodes touch that no motion balances them."""
        free = max(float(touching.gap.min()), 0.0)
        depth = np.array([0.0, 0.0, free + FIRST_DEPTH_SHARES[attempt] * solver.LONGEST_STEP])
        pose = touching.pose
        state = self.move(touching, Pose(pose.position - depth, pose.rotation))
        try:
            return follow_load(self._step, state, load)
        except LoadError as error:
            last = attempt + 1 == len(FIRST_DEPTH_SHARES)
            too_deep = self.load(state).normal > load.normal
            if last or too_deep or not isinstance(error.__cause__, solver.NotConvergedError):
                raise
        return self._press_from_above(touching, load, attempt + 1)

    def _moved_at_last(
        self, state: ContactState, way: tuple[Pose, Pose], ends: list[float]
    ) -> tuple[ContactState, float]:
        """The state after a step that is solved as nearly as is accepted, and its share of the way.

        ends: shares of the way that are tried, in this order.
        """
        failures = []
        for step, accepted in zip(self._lenient_steps, LAST_RESORTS, strict=True):
            for end in ends:
                try:
                    reached = step(state, way[0].towards(way[1], end))
                except solver.NotConvergedError as error:
                    failures.append(error)
                    continue
                name = self.indenter.name
                LOGGER.info("%s: the residual of a step is up to %.1g m", name, accepted)
                return reached, end
        nearest = min(failures, key=lambda error: error.residual)
        raise self._unsolved(way[0].towards(way[1], ends[0]), nearest) from None

    @property
    def _longest_step(self) -> float:
        longest = solver.LONGEST_STEP
        return float(np.clip(self.indenter.feature, FINEST_STEP_SHARE * longest, longest))

    def _way(self, begin: Pose, end: Pose) -> float:
        """Bound of the way of the indenter's points that may touch, m."""
        nodes = self.elastomer.node_position
        arm = min(
            self.indenter.reach,
            float(np.linalg.norm(nodes - begin.position, axis=1).max()),
        )
        turn = Rotation.from_matrix(end.rotation @ begin.rotation.T).magnitude()
        return float(np.linalg.norm(end.position - begin.position) + turn * arm)

    def _unsolved(
        self, pose: Pose, error: solver.NotConvergedError
    ) -> ContactError | MaterialError:
        if isinstance(error.__cause__, MaterialError):
            return error.__cause__
        x, y, z = 1e3 * pose.position
        return ContactError(
            f"{self.indenter.name}: the contact at ({x:.3f}, {y:.3f}, {z:.3f}) mm has no "
            f"solution: found a residual of {error.residual:.3g} m, expected below "
            f"{LAST_RESORTS[-1]:.3g} m; change contact_nodes, or indenter.friction slightly"
        )


def _last_steps(first: float) -> list[float]:
    """Lengths of steps where the shortest was not solved: shorter ones, then longer ones.

    Nodes that jump as they let go can be passed by a step beyond the jump.
    """
    shortest = LEAST_STEP_SHARE * first
    shorter = int(np.log2(LEAST_STEP_SHARE / LAST_STEP_SHARE)) + 1
    longer = int(np.log2(1 / LEAST_STEP_SHARE)) + 1
    return [shortest / 2**n for n in range(shorter)] + [shortest * 2**n for n in range(1, longer)]


def _between_nodes(elastomer: Elastomer) -> Array:
    """Points of the contact patch at rest, TOUCH_POINTS of them for each node and way, (n, 3) m."""
    grid = elastomer.nodes
    height = elastomer.node_position[:, 2].reshape(grid.rows, grid.cols)
    x, y = (
        np.linspace(line[0], line[-1], TOUCH_POINTS * (len(line) - 1) + 1)
        for line in (grid.x, grid.y)
    )
    fine = RectBivariateSpline(grid.y, grid.x, height)(y, x)
    points = np.stack([*np.meshgrid(x, y), fine], axis=-1)
    return np.asarray(points.reshape(-1, 3))


def _size_mm(elastomer: Elastomer) -> str:
    return " x ".join(f"{1e3 * extent:.2f}" for extent in elastomer.nodes.extent)


def carried_load(elastomer: Elastomer, state: ContactState) -> Load:
    """What the indenter presses with: nodal forces act at the nodes' deformed positions."""
    arm = elastomer.node_position + state.displacement - state.pose.position
    x, y, z = state.resultant.tolist()
    torque = float((arm[:, 0] * state.force[:, 1] - arm[:, 1] * state.force[:, 0]).sum())
    return Load(-z, (x, y), torque)


def check_load(load: Load, friction: float) -> None:
    """Raise LoadError for a load that no contact carries."""
    numbers = _numbers(load)
    expected = ""
    if not np.isfinite(numbers).all():
        expected = "finite numbers"
    elif load.normal < 0:
        expected = "a normal force of at least 0, because the gel does not stick to the indenter"
    elif load.normal == 0 and numbers.any():
        expected = "a normal force above 0 for tangential force and torque"
    elif friction == 0 and numbers[[0, 1, 3]].any():
        expected = "friction above 0 for tangential force and torque"
    if expected:
        msg = f"load: found {_text(load)}, expected {expected}"
        raise LoadError(msg)


def follow_load(step: ContactStep, state: ContactState, load: Load) -> ContactState:
    """The state under `load`, from one that touches; see ContactSimulation.press."""
    try:
        for goal in _goals(carried_load(step.elastomer, state), load):
            for passed in _followed(step, state, goal):
                state = passed
    except (solver.NotConvergedError, ContactError) as error:
        reached = _text(carried_load(step.elastomer, state))
        why = error.__cause__ if isinstance(error, solver.NotConvergedError) else error
        reason = "" if why is None else f": {why}"
        msg = (
            f"{step.indenter.name}: load: found {reached}, expected {_text(load)}, with a "
            f"friction coefficient of {step.friction:g}{reason}"
        )
        raise LoadError(msg) from error
    return state


def _goals(begin: Load, end: Load) -> list[Load]:
    """The corners of the way from one load to another: see ContactSimulation.press."""
    if end.normal >= begin.normal:
        corner = Load(end.normal, begin.tangential, begin.torque)
    else:
        corner = Load(begin.normal, end.tangential, end.torque)
    return [corner, end]


def _followed(step: ContactStep, state: ContactState, goal: Load) -> Iterator[ContactState]:
    """States along the straight way from the present load to the goal."""
    begin, end = _numbers(carried_load(step.elastomer, state)), _numbers(goal)
    missed = np.abs((end - begin) * (1.0, 1.0, 1.0, 1.0 / solver.CONTACT_ARM)).max()
    carried = missed < solver.LOAD_TOLERANCE * abs(end[2])
    if carried and not step.elastomer.creeps:
        return
    share, ahead = 0.0, 1.0 if carried else FIRST_SHARE
    longest = solver.LONGEST_STEP
    while share < 1:
        reach = min(1.0, share + ahead)
        try:
            reached = step(state, state.pose, begin + reach * (end - begin))
        except solver.NotConvergedError:
            ahead /= 4
            if ahead < LEAST_SHARE:
                raise
            continue
        way = solver.way_between(state.pose, reached.pose)
        state, share = reached, reach
        ahead *= float(np.clip(longest / max(way, 1e-12), 0.3, 3.0))
        yield state


def _numbers(load: Load) -> Array:
    """Force on the gel along x, y, z, N, and torque, N m."""
    return np.array([*load.tangential, -load.normal, load.torque])


def _text(load: Load) -> str:
    x, y = load.tangential
    return (
        f"normal {load.normal:.4g} N, tangential ({x:.4g}, {y:.4g}) N, torque {load.torque:.4g} N m"
    )
