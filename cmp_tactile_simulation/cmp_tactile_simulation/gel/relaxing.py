"""A gel that creeps, around one that does not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.elastic.relaxation import step_weights
from cmp_tactile_processing.sensor.parts import GelRelaxation
from cmp_tactile_simulation.gel.linear import LinearElastomer

Array = NDArray[np.float64]


class RelaxingElastomer:
    """An elastomer with one Prony term: its forces fade while its shape stays.

    Quasi-linear viscoelasticity: the elastic forces g, which would hold a shape at once, and the
    forces f, which hold it after its history, differ by what the gel has given up,

        f(t) = g(t) - share q(t),    dq/dt = (g - q) / time.

    For a linear gel this is exact linear viscoelasticity with a common relaxation of all moduli:
    contact area, friction and shape follow from the contact solver, loading and unloading alike.
    For a neo-Hookean one it takes the relaxation to act on the nodal forces.

    Time goes on by `advance`; all displacements between two calls are those at the end of the
    step, over which g grows along a straight line.  A gel that was let go keeps a dent that
    fades: its displacement without force is not zero.
    """

    creeps = True
    softens = True

    def __init__(self, elastic: LinearElastomer, relaxation: GelRelaxation) -> None:
        self.elastic, self.relaxation = elastic, relaxation
        # What does not change with time is that of the inner one; see LinearElastomer.
        self.nodes, self.observers = elastic.nodes, elastic.observers
        self.node_position, self.node_area = elastic.node_position, elastic.node_area
        self.on_rim, self.beyond = elastic.on_rim, elastic.beyond
        nothing = np.zeros_like(elastic.node_position)
        self._lag, self._before, self._step_s = nothing, nothing, 0.0

    def advance(self, force: Array, seconds: float) -> None:
        """Let time go on by `seconds`; force (N, 3) N: what the step that ends was solved for."""
        reached = self._elastic_force(force)
        kept, before, now = self._weights()
        self._lag = kept * self._lag + before * self._before + now * reached
        self._before, self._step_s = reached, float(seconds)

    def forget(self) -> None:
        """Be a gel that was never touched."""
        nothing = np.zeros_like(self._lag)
        self._lag, self._before, self._step_s = nothing, nothing, 0.0

    def compliance(self, active: NDArray[np.intp]) -> Array:
        """Displacement of the active nodes for unit forces on them, (3 k, 3 k) m/N.

        What a force does that is there only at the end of the step: a gel that relaxes within a
        step is softer.
        """
        return self.elastic.compliance(active) / self._instant_share()

    def displacement(self, force: Array) -> Array:
        """Displacement of the contact nodes (N, 3) m under nodal forces (N, 3) N.

        Raises MaterialError where the material cannot follow.
        """
        return self.elastic.displacement(self._elastic_force(force))

    def marker_displacement(self, force: Array) -> Array:
        """Displacement of the marker surface at the observers, (rows, cols, 3) m.

        Raises MaterialError where the material cannot follow.
        """
        return self.elastic.marker_displacement(self._elastic_force(force))

    def _elastic_force(self, force: Array) -> Array:
        """The forces that would hold the shape at once, (N, 3) N, of those that hold it now."""
        kept, before, _ = self._weights()
        remembered = kept * self._lag + before * self._before
        return (force + self.relaxation.share * remembered) / self._instant_share()

    def _instant_share(self) -> float:
        """What of a force that grew over the step is not relaxed at its end."""
        return 1.0 - self.relaxation.share * self._weights()[2]

    def _weights(self) -> tuple[float, float, float]:
        kept, before, now = step_weights(np.array(self._step_s / self.relaxation.time))
        return float(kept), float(before), float(now)
