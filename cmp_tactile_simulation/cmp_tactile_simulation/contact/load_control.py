"""Driving the indenter by load: the way to it in steps that the contact can follow."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_simulation.contact.solver import CONTACT_ARM, NotConvergedError, way_between
from cmp_tactile_simulation.contact.state import ContactState, Load
from cmp_tactile_simulation.contact.step import ContactStep
from cmp_tactile_simulation.errors import ContactError, LoadError
from cmp_tactile_simulation.gel.elastomer import Elastomer

__all__ = ["carried_load", "check_load", "follow_load"]

# Share of the way to the load in the first step, and the shortest that is tried.
FIRST_SHARE, LEAST_SHARE = 0.02, 1e-3


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
        expected = "a normal force of at least 0: the gel does not stick to the indenter"
    elif load.normal == 0 and numbers.any():
        expected = "a normal force above 0 to carry tangential force and torque"
    elif friction == 0 and numbers[[0, 1, 3]].any():
        expected = "friction above 0 to drive tangential force and torque"
    if expected:
        msg = f"load: found {_text(load)}, expected {expected}"
        raise LoadError(msg)


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
            f"{step.indenter.name}: load: asked for {_text(load)}, reached {reached} with a "
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
    missed = np.abs((end - begin) * (1.0, 1.0, 1.0, 1.0 / CONTACT_ARM)).max()
    carried = missed < step.settings.load_tolerance * abs(end[2])
    if carried and not step.elastomer.creeps:
        return
    share, ahead = 0.0, 1.0 if carried else FIRST_SHARE
    longest = step.settings.step
    while share < 1:
        reach = min(1.0, share + ahead)
        try:
            reached = step(state, state.pose, begin + reach * (end - begin))
        except NotConvergedError:
            ahead /= 4
            if ahead < LEAST_SHARE:
                raise
            continue
        way = way_between(state.pose, reached.pose)
        state, share = reached, reach
        ahead *= float(np.clip(longest / max(way, 1e-12), 0.3, 3.0))
        yield state


def _numbers(load: Load) -> NDArray[np.float64]:
    """Force on the gel along x, y, z, N, and torque, N m."""
    return np.array([*load.tangential, -load.normal, load.torque])


def _text(load: Load) -> str:
    x, y = load.tangential
    return (
        f"normal {load.normal:.4g} N, tangential ({x:.4g}, {y:.4g}) N, torque {load.torque:.4g} N m"
    )
