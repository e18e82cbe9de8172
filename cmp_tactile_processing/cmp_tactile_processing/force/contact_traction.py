"""Second pass: the traction on the nodes that are in contact, all others being free of it.

The posterior of a linear model with Gaussian noise and a smooth prior.  How large the normal and
the tangential traction are expected to be, and how large the noise is, follows from the frame
itself (type-II maximum likelihood, MacKay 1992).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.force import likeliest_scale
from cmp_tactile_processing.force.likeliest_scale import Likeliest, Problem, Solution
from cmp_tactile_processing.force.positive_definite import Array, backward, forward

# Draws from the posterior that traces and nodal deviations are estimated from: 3 % of a trace.
DRAWS = 32
# Deviation of a weight's logarithm above which the evidence is too flat to show it.
DOUBTFUL = 0.5
# Nodes come into a mask and leave it in threes, as neighbours of one that stands out.
TOGETHER = 3.0
NONE_ABSENT = np.zeros((0, 0))


@dataclass(frozen=True)
class TractionScale:
    """Expected size of normal and tangential coefficients, N, and squared noise of the data."""

    normal: float
    tangential: float
    noise_squared: float

    @classmethod
    def from_array(cls, parts: Array) -> TractionScale:
        """From an array (3,) as `likeliest_scale` has them."""
        return cls(float(parts[1]), float(parts[0]), float(parts[2]))

    def as_array(self) -> Array:
        """Array (3,) as `likeliest_scale` has them."""
        return np.array([self.tangential, self.normal, self.noise_squared], dtype=np.float64)

    def over(self, other: TractionScale) -> TractionScale:
        """Each part of this scale as a share of the other's."""
        return TractionScale.from_array(self.as_array() / other.as_array())

    def times(self, share: TractionScale) -> TractionScale:
        """This scale changed by such shares."""
        return TractionScale.from_array(self.as_array() * share.as_array())


@dataclass(frozen=True)
class TractionPosterior:
    """Coefficients on the nodes of the mask, and how well they are known.

    nodes (k,): numbers.  coefficient (3 k,) N.  draws (DRAWS, 3 k): deviations as the posterior has
    them.  scale: the likeliest, which the coefficients are for; solution: for one nearby.
    drift (3 k, 2): how the coefficients change along the two ways in which the scale may be off by
    its own deviation.  edge (k,): nodes that a little more noise would have left out of the mask,
    so that whether they bear anything is in doubt.
    """

    nodes: NDArray[np.intp]
    coefficient: Array
    draws: Array
    scale: TractionScale
    solution: Solution
    drift: Array
    edge: NDArray[np.bool_] | None = None

    @property
    def factor(self) -> Array:
        """R (3 k, 3 k), of which the upper triangle counts: R' R is the covariance's inverse."""
        return self.solution.upper

    @cached_property
    def _edge_nodes(self) -> NDArray[np.intp]:
        none = np.zeros(0, dtype=np.intp)
        return none if self.edge is None else np.flatnonzero(self.edge)

    def covariances(self, functionals: Array) -> tuple[Array, Array]:
        """Covariance (j, j) of linear functionals (j, 3 k) of the coefficients, for this scale.

        With it what scale and edge leave open on top of that, (j, j).
        """
        return _covariances(
            functionals, self.factor, self.drift, self.coefficient, self.draws, self._edge_nodes
        )


class ContactTraction:
    """Solves for the coefficients on some of the nodes.

    response G (3 markers, 3 nodes): displacement in units of its noise, per N.  pull: gives G' d.
    smoothness (nodes, nodes): precision of one component.
    """

    def __init__(self, response: Array, pull: Callable[[Array], Array], smoothness: Array) -> None:
        self._response, self._pull = response, pull
        self._normal = np.asarray(response.T @ response)
        self._smoothness = smoothness
        draws = np.random.default_rng(0).normal(size=(len(self._normal), DRAWS))
        self._draws = np.ascontiguousarray(draws.T)
        # Compiled, or read from numba's cache, before the first frame.
        data, known = np.ones(len(response)), np.ones(len(response), dtype=bool)
        one = self.solve(data, known, np.arange(1), TractionScale(1, 1, 1))
        self.again(one, data, known).covariances(np.zeros((1, 3)))

    def solve(
        self,
        data: Array,
        known: NDArray[np.bool_],
        nodes: NDArray[np.intp],
        first: TractionScale,
        begin: TractionScale | None = None,
    ) -> TractionPosterior:
        """Posterior given data (m,), in units of the noise, of which the `known` count.

        nodes (k,): where there may be traction.  first: a scale from this frame alone, to begin
        with.  begin: one from elsewhere that may be nearer; it decides how many solutions it takes
        to find the likeliest scale, and not where they end.  Raises GeometryError for no nodes.
        """
        problem = self._problem(data, known, nodes)
        found = likeliest_scale.search(problem, (begin or first).as_array())
        if found.doubt > DOUBTFUL and begin is not None:
            # So flat that where the search ends may hang on where it began.
            found = likeliest_scale.search(problem, first.as_array())
        return _posterior(nodes, found)

    def posterior(
        self,
        data: Array,
        known: NDArray[np.bool_],
        nodes: NDArray[np.intp],
        scale: TractionScale,
    ) -> TractionPosterior:
        """The posterior for a scale that is known; all else as in `solve`."""
        problem, parts = self._problem(data, known, nodes), scale.as_array()
        solution = likeliest_scale.solve(problem, parts)
        none = np.zeros((len(problem.pull), 2))
        found = Likeliest(solution, parts, solution.right, none, 0.0)
        return _posterior(nodes, found)

    def again(
        self, posterior: TractionPosterior, data: Array, known: NDArray[np.bool_]
    ) -> TractionPosterior:
        """The posterior for other data of the same markers, on the same nodes, for the same scale.

        A tenth of the work: all but the coefficients stays.
        """
        pull = self._pull(np.where(known, data, 0.0))[_unknowns(posterior.nodes)]
        scale, smoothness = posterior.scale.as_array(), self._smoothness
        coefficient = likeliest_scale.solve_again(
            posterior.solution, scale, pull, smoothness, posterior.nodes
        )
        return replace(posterior, coefficient=coefficient)

    def _problem(self, data: Array, known: NDArray[np.bool_], nodes: NDArray[np.intp]) -> Problem:
        if not len(nodes):
            msg = "nodes: found none, expected at least 1"
            raise GeometryError(msg)
        unknowns, missing = _unknowns(nodes), np.flatnonzero(~known)
        absent = NONE_ABSENT
        if len(missing):
            data = np.where(known, data, 0.0)
            rows = self._response[missing][:, unknowns]
            absent = np.ascontiguousarray(rows.T @ rows)
        return Problem(
            self._normal,
            self._smoothness,
            nodes,
            absent,
            self._pull(data)[unknowns],
            float(data @ data),
            len(data) - len(missing),
            _normalised(self._draws, nodes),
        )


def _posterior(nodes: NDArray[np.intp], found: Likeliest) -> TractionPosterior:
    scale, right = TractionScale.from_array(found.scale), found.right
    return TractionPosterior(nodes, right[0], right[1:], scale, found.solved, found.drift)


def _unknowns(nodes: NDArray[np.intp]) -> NDArray[np.intp]:
    return np.asarray((3 * nodes[:, None] + np.arange(3)).ravel())


@njit(cache=True, nogil=True, error_model="numpy")
def _normalised(draws: Array, nodes: NDArray[np.intp]) -> Array:
    """Draws (j, 3 k) with each component's square exactly what it is expected to be.

    Where the data say little of many coefficients, the few that they fix would else be lost in
    the scatter of the others.  draws (j, 3 nodes): of all nodes.
    """
    found: Array = np.empty((len(draws), 3 * len(nodes)))
    for row in range(len(draws)):
        for c in range(3):
            total = 0.0
            for node in nodes:
                total += draws[row, 3 * node + c] ** 2
            size = np.sqrt(total / len(nodes))
            for place, node in enumerate(nodes):
                found[row, 3 * place + c] = draws[row, 3 * node + c] / size
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _covariances(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    functionals: Array,
    upper: Array,
    drift: Array,
    coefficient: Array,
    draws: Array,
    edge: NDArray[np.intp],
) -> tuple[Array, Array]:
    """As TractionPosterior.covariances; edge: which of the mask's nodes are on it."""
    half = functionals.copy()
    forward(upper, half)
    for_scale = np.dot(half, half.T)
    of_scale = np.dot(functionals, drift)
    doubt = np.dot(of_scale, of_scale.T)
    if len(edge) > 0:
        # How functionals change where a node of the edge is free of traction.
        backward(upper, half)
        for node in edge:
            lost: Array = np.zeros(len(half))
            for i in range(3 * node, 3 * node + 3):
                # The variance as the draws show it.
                pull = coefficient[i] / (draws[:, i] ** 2).mean()
                for j in range(len(half)):
                    lost[j] += half[j, i] * pull
            doubt += TOGETHER * np.outer(lost, lost)
    return for_scale, doubt
