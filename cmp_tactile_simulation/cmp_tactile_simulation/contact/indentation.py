"""Contact between a rigid indenter and the gel, driven by place or by load, step by step."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from cmp_tactile_processing.errors import ContactError, NotConvergedError
from cmp_tactile_simulation.contact import solver
from cmp_tactile_simulation.contact.laws import ContactState, Load, Pose
from cmp_tactile_simulation.contact.step import ContactStep
from cmp_tactile_simulation.indenters import Indenter
from cmp_tactile_simulation.neo_hookean_gel import Elastomer

Array = NDArray[np.float64]
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

    @cached_property
    def _lenient_steps(self) -> list[ContactStep]:
        return [
            ContactStep(self.elastomer, self.indenter, self.friction, accepted)
            for accepted in LAST_RESORTS
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
        Raises ContactError where the contact leaves its patch, is not solved, or the gel cannot
        follow.
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
            except NotConvergedError:
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
        Raises ContactError for a load that cannot be carried, with what was asked and reached.
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

    def stiffness(self, state: ContactState) -> Array:
        """How force and moment on the gel change as the indenter moves, (6, 6), gel frame.

        About the indenter's origin; N and N m per m and rad.  Zeros where nothing touches.
        """
        return self._step.stiffness(state)

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
        except ContactError as error:
            last = attempt + 1 == len(FIRST_DEPTH_SHARES)
            too_deep = self.load(state).normal > load.normal
            if last or too_deep or not isinstance(error.__cause__, NotConvergedError):
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
                except NotConvergedError as error:
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
        return float(np.linalg.norm(end.position - begin.position)) + begin.turn_to(end) * arm

    def _unsolved(self, pose: Pose, error: NotConvergedError) -> ContactError:
        if isinstance(error.__cause__, ContactError):
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
    """Raise ContactError for a load that no contact carries."""
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
        raise ContactError(msg)


def follow_load(step: ContactStep, state: ContactState, load: Load) -> ContactState:
    """The state under `load`, from one that touches; see ContactSimulation.press."""
    try:
        for goal in _goals(carried_load(step.elastomer, state), load):
            for passed in _followed(step, state, goal):
                state = passed
    except (NotConvergedError, ContactError) as error:
        reached = _text(carried_load(step.elastomer, state))
        why = error.__cause__ if isinstance(error, NotConvergedError) else error
        reason = "" if why is None else f": {why}"
        msg = (
            f"{step.indenter.name}: load: found {reached}, expected {_text(load)}, with a "
            f"friction coefficient of {step.friction:g}{reason}"
        )
        raise ContactError(msg) from error
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
        except NotConvergedError:
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
