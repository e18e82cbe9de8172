"""Equilibrium of a neo-Hookean block under dead loads, followed from one load to the next.

The least energy is sought with the inverse stiffness at rest, which is never factorised anew; what
the large strain changes of it is learnt from the latest steps (limited-memory BFGS, Nocedal and
Wright, Numerical Optimization, algorithm 7.4).  They stay of use while the load changes little, so
that a new frame takes a step or two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.elastic.large_press_factor import ParityFactor
from cmp_tactile_processing.elastic.neo_hookean import NeoHookeanElements

__all__ = ["PressedBlock"]

Array = NDArray[np.float64]

# A step that moves the marker surface by less than this share of its displacement is the last.
SHARE = 5e-4
MAX_STEPS = 60
# Steps that are remembered; twice as many save a press of 1 mm little.
MEMORY = 8
MAX_HALVINGS = 6
# Share of the slope by which the energy must fall.
LEAST_FALL = 1e-4


@dataclass(frozen=True)
class _State:
    """A displacement, its potential energy under some load, and what is left of the load."""

    displacement: Array
    energy: float
    residual: Array


@dataclass(frozen=True)
class _Step:
    """How far a step led, (nodes, 3) m, and by how much it made the residual smaller."""

    way: Array
    change: Array
    work: float


class PressedBlock:
    """The latest equilibrium of a block, for a body of E = 1 Pa.

    elements, factor: of the same whole block.  lattice: its numbers of nodes along x, y and z.
    level: the lattice level of the marker surface.
    """

    def __init__(
        self,
        elements: NeoHookeanElements,
        factor: ParityFactor,
        lattice: tuple[int, int, int],
        level: int,
    ) -> None:
        self._elements, self._factor = elements, factor
        self._shape, self._level = (*lattice, 3), level
        self.steps = 0
        self.reset()

    def reset(self) -> None:
        """Back to rest."""
        self.displacement = np.zeros((self._elements.node_count, 3))
        self._steps: list[_Step] = []

    def move_to(self, load: Array, accuracy: float = 0.0) -> bool:
        """Bring `displacement` (nodes, 3) m to equilibrium with a load (nodes, 3).

        accuracy: root mean square of a step at the marker surface, m, below which it is the last
        one; so it is below SHARE of the displacement.  Tells whether an equilibrium was found,
        from the latest one on or from rest; if not, the block is at rest.  `steps` counts what
        it took.
        """
        self.steps = 0
        if not load.any():
            self.reset()
            return True
        if self._relax(load, accuracy):
            return True
        warm = bool(self.displacement.any())
        self.reset()
        found = warm and self._relax(load, accuracy)
        if not found:
            self.reset()
        return found

    def _relax(self, load: Array, accuracy: float) -> bool:
        state = self._state(self.displacement, load)
        for _ in range(MAX_STEPS):
            self.steps += 1
            way = self._way(state.residual)
            reached = state.displacement + way
            if self._size(way) <= max(accuracy, SHARE * self._size(reached)):
                self.displacement = reached
                return True
            further = self._line_search(state, load, way)
            if further is None:
                if not self._steps:
                    return False
                self._steps = []
                continue
            self._remember(state, further)
            state = further
        return False

    def _state(self, displacement: Array, load: Array) -> _State:
        material = self._elements.equilibrium(displacement)
        residual = load - material.force
        residual.reshape(self._shape)[:, :, 0] = 0
        energy = material.energy - float(np.vdot(load, displacement))
        return _State(displacement, energy, residual)

    def _way(self, residual: Array) -> Array:
        """The way to the equilibrium as far as the remembered steps tell the stiffness."""
        left, shares = residual.copy(), []
        for step in reversed(self._steps):
            shares.append(float(np.vdot(step.way, left)) / step.work)
            left -= shares[-1] * step.change
        way = self._factor.solve(left)
        for step, share in zip(self._steps, reversed(shares), strict=True):
            way += (share - float(np.vdot(step.change, way)) / step.work) * step.way
        return way

    def _line_search(self, state: _State, load: Array, way: Array) -> _State | None:
        """A state of less energy on the way; none turns an element inside out."""
        slope = float(np.vdot(state.residual, way))
        for halvings in range(MAX_HALVINGS + 1):
            share = 0.5**halvings
            trial = self._state(state.displacement + share * way, load)
            if trial.energy <= state.energy - LEAST_FALL * share * slope:
                return trial
        return None

    def _remember(self, before: _State, after: _State) -> None:
        way, change = after.displacement - before.displacement, before.residual - after.residual
        work = float(np.vdot(way, change))
        # Where the stiffness is not positive along the way, the step would spoil the next one.
        if work > 1e-10 * float(np.linalg.norm(way) * np.linalg.norm(change)):
            self._steps = [*self._steps, _Step(way, change, work)][-MEMORY:]

    def _size(self, displacement: Array) -> float:
        """Root mean square at the marker surface, m."""
        surface = displacement.reshape(self._shape)[:, :, self._level]
        return float(np.sqrt(np.mean(surface**2)))
