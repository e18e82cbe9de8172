"""Equilibrium of a neo-Hookean block under dead loads, followed from one load to the next.

Two ways to the state of least energy.  Newton's method factorises the stiffness of the deformed
block where it has to, and is exact: `NewtonEquilibrium`.  The other, `QuickEquilibrium`, keeps to
the inverse stiffness at rest; what large strain changes of it is learnt from the latest steps
(limited-memory BFGS, Nocedal and Wright, Numerical Optimization, algorithm 7.4).  They stay of use
while the load changes little, so that a new frame takes a step or two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.elastic.cholesky import (
    BlockFactor,
    Dissection,
    RestInverse,
)
from cmp_tactile_processing.elastic.mesh import BlockMesh
from cmp_tactile_processing.elastic.neo_hookean import NeoHookeanElements
from cmp_tactile_processing.errors import NotConvergedError

Array = NDArray[np.float64]

# Share of the slope by which the energy must fall.
LEAST_FALL = 1e-4

# Newton's method.  Residual force over applied force.
TOLERANCE = 1e-7
# A factor is kept while every step with it shrinks the residual to this share or less: a step
# costs a twentieth of a factor.
GOOD_SHRINKAGE = 0.4
MAX_STEPS, MAX_FACTORS, MAX_HALVINGS = 40, 8, 8
# A way that leads through more unstable states than this ends in none that is stable.
MAX_UNSTABLE = 2
SHORTEST_LOAD_STEP = 1 / 2
# Shares of the stiffness at rest that are added where the tangent alone is not positive definite.
SUPPORT = (0.0, 0.03, 0.3, 3.0)

# The quick way.  A step that moves the marker surface by less than this share of its displacement
# is the last.
SHARE = 5e-4
MAX_QUICK_STEPS, MAX_QUICK_HALVINGS = 60, 6
# Steps that are remembered; twice as many save a press of 1 mm little.
MEMORY = 8


@dataclass(frozen=True)
class _State:
    """A displacement, its potential energy under some load, and what is left of the load."""

    displacement: Array
    energy: float
    residual: Array

    @property
    def size(self) -> float:
        return float(np.linalg.norm(self.residual))


class _Block:
    """The latest equilibrium of a block held at its base: displacement (nodes, 3) m."""

    def __init__(self, mesh: BlockMesh, elements: NeoHookeanElements) -> None:
        self._lattice, self._elements = mesh.lattice, elements
        self.displacement = np.zeros((elements.node_count, 3))

    def _state(self, displacement: Array, load: Array) -> _State:
        material = self._elements.equilibrium(displacement)
        residual = load - material.force
        residual.reshape(*self._lattice, 3)[:, :, 0] = 0
        energy = material.energy - float(np.vdot(load, displacement))
        return _State(displacement, energy, residual)

    def _line_search(
        self, state: _State, load: Array, way: Array, halvings: int, shrinkage: float = 0.0
    ) -> _State | None:
        """A better state on the way; none turns an element inside out.

        shrinkage: a residual of this share of the last one will do as well as less energy, where
        close to the solution the energy's last digits say less.
        """
        slope = float(np.vdot(state.residual, way))
        for halving in range(halvings + 1):
            share = 0.5**halving
            trial = self._state(state.displacement + share * way, load)
            if not np.isfinite(trial.energy):
                continue
            falls = trial.energy <= state.energy - LEAST_FALL * share * slope
            if falls or trial.size <= shrinkage * state.size:
                return trial
        return None


@dataclass(frozen=True)
class _Tangent:
    """A factor of the stiffness at a displacement (nodes, 3) m.

    support: share of the stiffness at rest that was added to it.
    """

    factor: BlockFactor
    displacement: Array
    support: float


class NewtonEquilibrium(_Block):
    """A block of which the next equilibrium is sought by Newton's method from the latest one on.

    displacement (nodes, 3) m under load (nodes, 3) N.  factorisations: how many it has cost.
    """

    def __init__(self, mesh: BlockMesh, elements: NeoHookeanElements) -> None:
        super().__init__(mesh, elements)
        self._dissection = Dissection(mesh.lattice, elements.nodes)
        self.load = np.zeros_like(self.displacement)
        self.factorisations = 0
        self._stiffness_at_rest = elements.tangent(self.displacement)
        self.factor_at_rest = self._dissection.factor(self._stiffness_at_rest)
        self._tangent = self._tangent_at_rest = _Tangent(
            self.factor_at_rest, np.zeros_like(self.displacement), 0.0
        )

    def move_to(self, load: Array) -> Array:
        """Displacement (nodes, 3) m under dead loads (nodes, 3) N.

        The load is applied in as many steps as it takes. Raises NotConvergedError where the
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
                raise NotConvergedError(self._complaint(load))
        return self.displacement

    @property
    def tangent_factor(self) -> BlockFactor:
        """Factor of the stiffness near the latest equilibrium, to within a Newton step."""
        return self._tangent.factor

    def _relax(self, load: Array) -> bool:
        """Seek the equilibrium under the load; whether it was found and is taken over."""
        tolerance = TOLERANCE * float(np.linalg.norm(load))
        state, tangent, factors = self._state(self.displacement, load), self._tangent, 0
        fresh, unstable = False, 0
        for _ in range(MAX_STEPS):
            if state.size <= tolerance:
                self._take(state.displacement, load, tangent)
                return True
            step = tangent.factor.solve(state.residual.ravel()).reshape(-1, 3)
            better = self._line_search(state, load, step, MAX_HALVINGS, GOOD_SHRINKAGE)
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

    def _tangent_at(self, displacement: Array) -> _Tangent:
        stiffness = self._elements.tangent(displacement)
        for support in SUPPORT:
            self.factorisations += 1
            try:
                factor = self._dissection.factor(stiffness + support * self._stiffness_at_rest)
            except np.linalg.LinAlgError:
                continue
            return _Tangent(factor, displacement, support)
        return self._tangent_at_rest

    def _complaint(self, load: Array) -> str:
        asked, held = (
            ", ".join(f"{part:.4g}" for part in force.sum(axis=0)) for force in (load, self.load)
        )
        stretch = self._elements.greatest_stretch(self.displacement)
        return (
            f"the neo-Hookean gel has no solution for the load ({asked}) N; the last solved load "
            f"is ({held}) N, with a greatest stretch of {stretch:.3g}"
        )


@dataclass(frozen=True)
class _Step:
    """How far a step led, (nodes, 3) m, and by how much it made the residual smaller."""

    way: Array
    change: Array
    work: float


class QuickEquilibrium(_Block):
    """A block of which the next equilibrium is sought with its inverse stiffness at rest.

    mesh, elements, inverse: of the same whole block, of E = 1 Pa.  steps: what the last call took.
    """

    def __init__(self, mesh: BlockMesh, elements: NeoHookeanElements, inverse: RestInverse) -> None:
        super().__init__(mesh, elements)
        self._inverse, self._level = inverse, mesh.marker_level
        self.steps = 0
        self.reset()

    def reset(self) -> None:
        """Back to rest."""
        self.displacement = np.zeros((self._elements.node_count, 3))
        self._steps: list[_Step] = []

    def move_to(self, load: Array, accuracy: float = 0.0) -> bool:
        """Bring `displacement` (nodes, 3) m to equilibrium with a load (nodes, 3).

        accuracy: root mean square of a step at the marker surface, m, below which it is the last
        one; so it is below SHARE of the displacement.  Returns whether an equilibrium was found,
        from the latest one on or from rest; where there is none, the block is at rest.
        """
        self.steps = 0
        if not load.any():
            self.reset()
            return True
        moved = bool(self.displacement.any())
        found = self._relax(load, accuracy)
        if not found and moved:
            self.reset()
            found = self._relax(load, accuracy)
        if not found:
            self.reset()
        return found

    def _relax(self, load: Array, accuracy: float) -> bool:
        state = self._state(self.displacement, load)
        for _ in range(MAX_QUICK_STEPS):
            self.steps += 1
            way = self._way(state.residual)
            reached = state.displacement + way
            if self._size(way) <= max(accuracy, SHARE * self._size(reached)):
                self.displacement = reached
                return True
            further = self._line_search(state, load, way, MAX_QUICK_HALVINGS)
            if further is None:
                if not self._steps:
                    return False
                self._steps = []
                continue
            self._remember(state, further)
            state = further
        return False

    def _way(self, residual: Array) -> Array:
        """The way to the equilibrium as far as the remembered steps show the stiffness."""
        left, shares = residual.copy(), []
        for step in reversed(self._steps):
            shares.append(float(np.vdot(step.way, left)) / step.work)
            left -= shares[-1] * step.change
        way = self._inverse.solve(left)
        for step, share in zip(self._steps, reversed(shares), strict=True):
            way += (share - float(np.vdot(step.change, way)) / step.work) * step.way
        return way

    def _remember(self, before: _State, after: _State) -> None:
        way, change = after.displacement - before.displacement, before.residual - after.residual
        work = float(np.vdot(way, change))
        # Where the stiffness is not positive along the way, the step would spoil the next one.
        if work > 1e-10 * float(np.linalg.norm(way) * np.linalg.norm(change)):
            self._steps = [*self._steps, _Step(way, change, work)][-MEMORY:]

    def _size(self, displacement: Array) -> float:
        """Root mean square at the marker surface, m."""
        surface = displacement.reshape(*self._lattice, 3)[:, :, self._level]
        return float(np.sqrt(np.mean(surface**2)))
