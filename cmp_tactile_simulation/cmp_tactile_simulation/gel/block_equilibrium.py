"""Equilibrium of a hyperelastic block under dead loads: Newton's method with a line search."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.elastic.neo_hookean import NeoHookeanElements
from cmp_tactile_simulation.errors import MaterialError
from cmp_tactile_simulation.gel.sparse_cholesky import (
    BlockDissection,
    BlockFactor,
    NotPositiveDefiniteError,
)

__all__ = ["BlockEquilibrium"]

Array = NDArray[np.float64]

# Residual force over applied force.
TOLERANCE = 1e-7
# A factor is kept while every step with it shrinks the residual to this share or less: a step
# costs a twentieth of a factor.
GOOD_SHRINKAGE = 0.4
MAX_STEPS = 40
MAX_FACTORS = 8
# A way that leads through more unstable states than this ends in none that is stable.
MAX_UNSTABLE = 2
MAX_HALVINGS = 8
# Share of the slope by which the energy must fall.
LEAST_FALL = 1e-4
SHORTEST_LOAD_STEP = 1 / 2
# Shares of the stiffness at rest that are added where the tangent alone is not positive definite.
SUPPORT = (0.0, 0.03, 0.3, 3.0)


@dataclass(frozen=True)
class _State:
    """A displacement, its potential energy under some load, and what is left of the load."""

    displacement: Array
    energy: float
    residual: Array

    @property
    def size(self) -> float:
        return float(np.linalg.norm(self.residual))


@dataclass(frozen=True)
class _Tangent:
    """A factor of the stiffness at a displacement (nodes, 3) m.

    support: share of the stiffness at rest that was added to it.
    """

    factor: BlockFactor
    displacement: Array
    support: float


class BlockEquilibrium:
    """The latest equilibrium of a block held at its base, from which the next one is sought.

    displacement (nodes, 3) m under load (nodes, 3) N.  factorisations: how many it has cost.
    """

    def __init__(self, elements: NeoHookeanElements, dissection: BlockDissection) -> None:
        self._elements = elements
        self._dissection = dissection
        self._free = np.zeros((elements.node_count, 3), dtype=bool)
        for front in dissection.fronts:
            self._free.ravel()[front.unknowns] = True
        self.displacement = np.zeros((elements.node_count, 3))
        self.load = np.zeros_like(self.displacement)
        self.factorisations = 0
        self._stiffness_at_rest = elements.tangent(self.displacement)
        self.factor_at_rest = dissection.factor(self._stiffness_at_rest)
        self._tangent = self._tangent_at_rest = _Tangent(
            self.factor_at_rest, np.zeros_like(self.displacement), 0.0
        )

    @property
    def memory(self) -> dict[str, Array]:
        """All of the past that the next displacement depends on, to its last digits."""
        return {
            "displacement": self.displacement,
            "load": self.load,
            "factored_at": self._tangent.displacement,
            "support": np.array(self._tangent.support),
        }

    def recall(self, memory: Mapping[str, Array]) -> None:
        """Go on as from where `memory` was taken."""
        factored_at, support = memory["factored_at"], float(memory["support"])
        tangent = self._tangent_at_rest
        if factored_at.any():
            stiffness = self._elements.tangent(factored_at) + support * self._stiffness_at_rest
            tangent = _Tangent(self._dissection.factor(stiffness), factored_at, support)
        self._take(memory["displacement"], memory["load"], tangent)

    def move_to(self, load: Array) -> Array:
        """Displacement (nodes, 3) m under dead loads (nodes, 3) N.

        The load is applied in as many steps as it takes. Raises MaterialError where the
        material cannot follow; the state is then that of the last step reached.
        """
        if not load.any():
            self._take(np.zeros_like(load), load, self._tangent_at_rest)
        start, done, step = self.load, 0.0, 1.0
        while done < 1:
            goal = load if done + step >= 1 else start + (done + step) * (load - start)
            if self._relax(goal):
                done += step
                step = min(2 * step, 1 - done)
            elif step > SHORTEST_LOAD_STEP:
                step /= 2
            else:
                raise MaterialError(self._complaint(load))
        return self.displacement

    def tangent_factor(self) -> BlockFactor:
        """Factor of the stiffness near the latest equilibrium, to within a Newton step."""
        return self._tangent.factor

    def _relax(self, load: Array) -> bool:
        """Seek the equilibrium under the load; tell whether it was found and is taken over."""
        tolerance = TOLERANCE * float(np.linalg.norm(load))
        state, tangent, factors = self._state(self.displacement, load), self._tangent, 0
        fresh, unstable = False, 0
        for _ in range(MAX_STEPS):
            if state.size <= tolerance:
                self._take(state.displacement, load, tangent)
                return True
            better = self._line_search(state, load, tangent.factor)
            if better is None and fresh:
                return False
            slow = better is None or better.size > GOOD_SHRINKAGE * state.size
            state = better or state
            fresh = slow and state.size > tolerance
            if fresh:
                tangent, factors = self._tangent_at(state.displacement), factors + 1
                unstable += tangent.support > 0
                if factors > MAX_FACTORS or unstable > MAX_UNSTABLE:
                    return False
        return False

    def _take(self, displacement: Array, load: Array, tangent: _Tangent) -> None:
        self.displacement, self.load, self._tangent = displacement, load, tangent

    def _state(self, displacement: Array, load: Array) -> _State:
        material = self._elements.equilibrium(displacement)
        energy = material.energy - float(np.vdot(load, displacement))
        return _State(displacement, energy, np.where(self._free, load - material.force, 0))

    def _line_search(self, state: _State, load: Array, factor: BlockFactor) -> _State | None:
        """A better state on the way of a Newton step; none turns an element inside out."""
        step = factor.solve(state.residual.ravel()).reshape(-1, 3)
        slope = float(np.vdot(state.residual, step))
        for halvings in range(MAX_HALVINGS + 1):
            share = 0.5**halvings
            trial = self._state(state.displacement + share * step, load)
            if not np.isfinite(trial.energy):
                continue
            # Close to the solution the energy's last digits say less than the residual.
            if (
                trial.energy <= state.energy - LEAST_FALL * share * slope
                or trial.size <= GOOD_SHRINKAGE * state.size
            ):
                return trial
        return None

    def _tangent_at(self, displacement: Array) -> _Tangent:
        stiffness = self._elements.tangent(displacement)
        for support in SUPPORT:
            self.factorisations += 1
            try:
                factor = self._dissection.factor(stiffness + support * self._stiffness_at_rest)
            except NotPositiveDefiniteError:
                continue
            return _Tangent(factor, displacement, support)
        return self._tangent_at_rest

    def _complaint(self, load: Array) -> str:
        asked, held = (
            ", ".join(f"{part:.4g}" for part in force.sum(axis=0)) for force in (load, self.load)
        )
        stretch = self._elements.greatest_stretch(self.displacement)
        return (
            f"the neo-Hookean gel cannot follow the load ({asked}) N; the last one that it "
            f"follows is ({held}) N, where the greatest stretch is {stretch:.3g}"
        )
