"""Second pass: the traction on the nodes that are in contact, all others being free of it.

The posterior of a linear model with Gaussian noise and a smooth prior.  How large the normal and
the tangential traction are expected to be, and how large the noise is, is told by the frame
itself (type-II maximum likelihood, MacKay 1992).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg.blas import dsyrk, dtrsm
from scipy.linalg.lapack import dpotrf

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.traction_prior import MIN_NOISE_SQUARED

__all__ = ["ContactTraction", "TractionPosterior", "TractionScale"]

# Draws from the posterior that traces and nodal deviations are estimated from: 3 % of a trace.
DRAWS = 32
# The tangential traction is never expected to be less than this share of the normal one.
MIN_TANGENTIAL = 0.02


@dataclass(frozen=True)
class TractionScale:
    """Expected size of normal and tangential coefficients, N, and squared noise of the data."""

    normal: float
    tangential: float
    noise_squared: float

    def weights(self) -> NDArray[np.float64]:
        """Weights of the prior of the three components, 1/N^2."""
        return np.array([self.tangential, self.tangential, self.normal]) ** -2.0


@dataclass(frozen=True)
class TractionPosterior:
    """Coefficients on the nodes of the mask, and how well they are known.

    nodes (k,): numbers.  coefficient (3 k,) N.  factor (3 k, 3 k): lower, L L' is the inverse of
    the covariance.  draws (3 k, DRAWS): deviations as the posterior has them.
    """

    nodes: NDArray[np.intp]
    coefficient: NDArray[np.float64]
    factor: NDArray[np.float64]
    draws: NDArray[np.float64]
    scale: TractionScale

    def covariance(self, functionals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Covariance (j, j) of linear functionals (j, 3 k) of the coefficients."""
        half = dtrsm(1.0, self.factor, functionals.T, lower=1)
        return np.asarray(half.T @ half)


class ContactTraction:
    """Solves for the coefficients on some of the nodes.

    response G (3 markers, 3 nodes): displacement in units of its noise, per N.  pull: gives G' d.
    smoothness (nodes, nodes): precision of one component.
    """

    def __init__(
        self,
        response: NDArray[np.float64],
        pull: Callable[[NDArray[np.float64]], NDArray[np.float64]],
        smoothness: NDArray[np.float64],
    ) -> None:
        self._response, self._pull = response, pull
        self._normal = np.asarray(response.T @ response)
        self._smoothness = smoothness
        self._draws = np.random.default_rng(0).normal(size=(len(self._normal), DRAWS))
        _assemble(self._normal, smoothness, np.arange(1), 1.0, np.ones(3))  # compile now

    def solve(
        self,
        data: NDArray[np.float64],
        known: NDArray[np.bool_],
        nodes: NDArray[np.intp],
        scale: TractionScale,
        rounds: int,
    ) -> TractionPosterior:
        """Posterior given data (m,), in units of the noise, of which the `known` count.

        nodes (k,): where there may be traction.  scale: what to begin with, settled in `rounds`
        solutions.  Raises GeometryError for no nodes.
        """
        if not len(nodes):
            msg = "nodes: found none, expected at least 1"
            raise GeometryError(msg)
        problem = self._problem(data, known, nodes)
        for _ in range(rounds):
            solution = problem.solution(scale)
            scale = problem.settled(solution)
        return replace(solution, scale=scale)

    def _problem(
        self, data: NDArray[np.float64], known: NDArray[np.bool_], nodes: NDArray[np.intp]
    ) -> _Problem:
        unknowns, missing = _unknowns(nodes), np.flatnonzero(~known)
        data = np.where(known, data, 0.0)
        absent = None
        if len(missing):
            rows = self._response[missing][:, unknowns]
            absent = dsyrk(1.0, rows, trans=1, lower=1)
        return _Problem(
            nodes,
            self._normal,
            self._smoothness,
            absent,
            self._pull(data)[unknowns],
            float(data @ data),
            len(data) - len(missing),
            self._draws[unknowns],
        )


@dataclass(frozen=True)
class _Problem:
    """One mask: normal equations of what is known, and their prior."""

    nodes: NDArray[np.intp]
    normal: NDArray[np.float64]
    smoothness: NDArray[np.float64]
    absent: NDArray[np.float64] | None
    pull: NDArray[np.float64]
    power: float
    count: int
    noise: NDArray[np.float64]

    def solution(self, scale: TractionScale) -> TractionPosterior:
        """The posterior for one scale."""
        matrix = _assemble(
            self.normal, self.smoothness, self.nodes, 1 / scale.noise_squared, scale.weights()
        )
        if self.absent is not None:
            matrix -= np.tril(self.absent) / scale.noise_squared
        factor, info = dpotrf(matrix, lower=1, clean=0, overwrite_a=1)
        if info:
            msg = f"contact traction: found a system that is not definite at unknown {info}"
            raise GeometryError(msg)
        right = np.column_stack([self.pull / scale.noise_squared, self.noise])
        forward = dtrsm(1.0, factor, right[:, :1], lower=1)
        right[:, :1] = forward
        solved = dtrsm(1.0, factor, right, lower=1, trans_a=1)
        return TractionPosterior(self.nodes, solved[:, 0], factor, solved[:, 1:], scale)

    def settled(self, solution: TractionPosterior) -> TractionScale:
        """The scale that the solution speaks for."""
        prior = self.smoothness[np.ix_(self.nodes, self.nodes)]
        columns = np.column_stack([solution.coefficient, solution.draws])
        energies = np.empty((3, columns.shape[1]))
        for component in range(3):
            part = columns[component::3]
            energies[component] = np.einsum("ij,ij->j", part, prior @ part)
        weights = solution.scale.weights()
        told = np.maximum(len(self.nodes) - weights * energies[:, 1:].mean(axis=1), 1.0)
        normal = np.sqrt(energies[2, 0] / told[2])
        tangential = np.sqrt(energies[:2, 0].sum() / told[:2].sum())
        f, noise = solution.coefficient, solution.scale.noise_squared
        # |G f - d|^2 by the normal equations: (G'G) f = G'd - noise * weights * P f.
        pulled = f @ self.pull - noise * float(weights @ energies[:, 0])
        misfit = max(self.power - 2 * f @ self.pull + pulled, 0.0)
        free = max(self.count - told.sum(), 0.1 * self.count)
        return TractionScale(
            max(normal, 1e-9),
            max(tangential, MIN_TANGENTIAL * normal, 1e-9),
            max(misfit / free, MIN_NOISE_SQUARED),
        )


def _unknowns(nodes: NDArray[np.intp]) -> NDArray[np.intp]:
    return np.asarray((3 * nodes[:, None] + np.arange(3)).ravel())


@njit(cache=True, nogil=True, error_model="numpy")
def _assemble(
    normal: NDArray[np.float64],
    smoothness: NDArray[np.float64],
    nodes: NDArray[np.intp],
    scale: float,
    weights: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Lower triangle of scale * normal + weights * smoothness on some nodes, columns contiguous."""
    count = 3 * len(nodes)
    transposed: NDArray[np.float64] = np.zeros((count, count))
    for a in range(len(nodes)):
        for c in range(3):
            row = transposed[3 * a + c]
            source = normal[3 * nodes[a] + c]
            for b in range(a, len(nodes)):
                first = 3 * nodes[b]
                for d in range(3):
                    row[3 * b + d] = scale * source[first + d]
                row[3 * b + c] += weights[c] * smoothness[nodes[a], nodes[b]]
    return transposed.T  # type: ignore[no-any-return]
