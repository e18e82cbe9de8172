"""Contact between a rigid indenter and the gel, driven by place or by load."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from cmp_tactile_simulation.contact.load_control import carried_load, check_load, follow_load
from cmp_tactile_simulation.contact.pose import Pose
from cmp_tactile_simulation.contact.settings import ContactSettings
from cmp_tactile_simulation.contact.solver import NotConvergedError
from cmp_tactile_simulation.contact.state import ContactState, Load
from cmp_tactile_simulation.contact.step import ContactStep
from cmp_tactile_simulation.errors import ContactError, LoadError, MaterialError
from cmp_tactile_simulation.gel.elastomer import Elastomer
from cmp_tactile_simulation.indenters.shapes import Indenter

__all__ = ["ContactSettings", "ContactSimulation"]

LOGGER = logging.getLogger(__name__)

# No step need be shorter than this share of the longest: sharper edges than that are met by
# shortening steps that fail.
FINEST_STEP_SHARE = 0.125
# A place that touches may be inside by this much, m.
TOUCH_TOLERANCE = 1e-9
MAX_TOUCH_STEPS = 1000
# Where it touches is looked for in so many steps from node to node.
TOUCH_POINTS = 4
# Shares of a way are equal if they differ by less.
ROUNDING = 1e-9
# How far the indenter goes into the gel before it follows a load, of the longest step.
FIRST_DEPTH_SHARES = (0.1, 0.5, 1.0, 2.0)


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
        settings: ContactSettings | None = None,
    ) -> None:
        if not 0 <= friction < np.inf:
            msg = f"friction: found {friction!r}, expected a finite number of at least 0"
            raise ContactError(msg)
        self.elastomer, self.indenter, self.friction = elastomer, indenter, float(friction)
        self.settings = settings or ContactSettings()
        self._step = ContactStep(elastomer, indenter, self.friction, self.settings)
        lenient = replace(self.settings, accepted=self.settings.last_resort)
        self._lenient_step = ContactStep(elastomer, indenter, self.friction, lenient)

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
                f"{self.indenter.name}: starts {-1e3 * gap[deepest]:.4g} mm inside the gel, "
                f"at ({x:.2f}, {y:.2f}, {z:.2f}) mm; expected outside or touching"
            )
            raise ContactError(msg)
        return state

    def move(self, state: ContactState, pose: Pose) -> ContactState:
        """The state after a straight motion at constant rates to `pose`, in steps short enough.

        A gel that creeps is solved anew also where nothing moves.
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
            except NotConvergedError:
                step /= 2
                if step >= self.settings.min_step_share * first:
                    continue
                state = self._moved_at_last(state, begin.towards(pose, end))
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
            f"{self.indenter.name}: let down at ({x:.2f}, {y:.2f}) mm it misses the contact "
            f"patch of {_size_mm(self.elastomer)} mm"
        )
        raise ContactError(msg)

    def _press_from_above(
        self, touching: ContactState, load: Load, attempt: int = 0
    ) -> ContactState:
        """Go in by a little, and farther where so few nodes touch that no motion balances them."""
        free = max(float(touching.gap.min()), 0.0)
        depth = np.array([0.0, 0.0, free + FIRST_DEPTH_SHARES[attempt] * self.settings.step])
        pose = touching.pose
        state = self.move(touching, Pose(pose.position - depth, pose.rotation))
        try:
            return follow_load(self._step, state, load)
        except LoadError as error:
            last = attempt + 1 == len(FIRST_DEPTH_SHARES)
            too_deep = self.load(state).normal > load.normal
            if last or too_deep or not isinstance(error.__cause__, NotConvergedError):
                raise
        return self._press_from_above(touching, load, attempt + 1)

    def _moved_at_last(self, state: ContactState, pose: Pose) -> ContactState:
        """The state after a step that no shortening solves exactly, as nearly as is accepted."""
        try:
            reached = self._lenient_step(state, pose)
        except NotConvergedError as error:
            raise self._unsolved(pose, error) from None
        LOGGER.info(
            "%s: a step was solved to no better than %.1g m",
            self.indenter.name,
            self.settings.last_resort,
        )
        return reached

    @property
    def _longest_step(self) -> float:
        longest = self.settings.step
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

    def _unsolved(self, pose: Pose, error: NotConvergedError) -> ContactError | MaterialError:
        if isinstance(error.__cause__, MaterialError):
            return error.__cause__
        x, y, z = 1e3 * pose.position
        return ContactError(
            f"{self.indenter.name}: the contact at ({x:.3f}, {y:.3f}, {z:.3f}) mm is not solved: "
            f"residual {error.residual:.3g} m, expected below {self.settings.last_resort:.3g} m"
        )


def _between_nodes(elastomer: Elastomer) -> NDArray[np.float64]:
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
