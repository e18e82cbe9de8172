"""Second pass: the traction on the nodes that are in contact, all others being free of it.

The posterior of a linear model with Gaussian noise and a smooth prior.  How large the normal and
the tangential traction are expected to be, and how large the noise is, is told by the frame
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
from cmp_tactile_processing.positive_definite import factor, forward, solve
from cmp_tactile_processing.traction_prior import MIN_NOISE_SQUARED

__all__ = ["ContactTraction", "TractionPosterior", "TractionScale"]

# Draws from the posterior that traces and nodal deviations are estimated from: 3 % of a trace.
DRAWS = 32
# The tangential traction is never expected to be less than this share of the normal one.
MIN_TANGENTIAL = 0.02
# A scale that a solution confirms to this share is settled: each round leaves a fifth of its error.
SETTLED_SHARE = 0.15
NONE_ABSENT = np.zeros((0, 0))


@dataclass(frozen=True)
class TractionScale:
    """Expected size of normal and tangential coefficients, N, and squared noise of the data."""

    normal: float
    tangential: float
    noise_squared: float

    def weights(self) -> NDArray[np.float64]:
        """Weights of the prior of the three components, 1/N^2."""
        return np.array([self.tangential, self.tangential, self.normal]) ** -2.0

    def over(self, other: TractionScale) -> TractionScale:
        """Each part of this scale as a share of the other's."""
        return TractionScale(
            self.normal / other.normal,
            self.tangential / other.tangential,
            self.noise_squared / other.noise_squared,
        )

    def times(self, share: TractionScale) -> TractionScale:
        """This scale changed by such shares."""
        return TractionScale(
            self.normal * share.normal,
            self.tangential * share.tangential,
            self.noise_squared * share.noise_squared,
        )

    def is_near(self, other: TractionScale) -> bool:
        """Whether no part differs by more than SETTLED_SHARE, that of the noise by its root."""
        change = self.over(other)
        noise = float(np.sqrt(change.noise_squared))
        parts = (change.normal, change.tangential, noise)
        return all(abs(part - 1.0) <= SETTLED_SHARE for part in parts)


@dataclass(frozen=True)
class TractionPosterior:
    """Coefficients on the nodes of the mask, and how well they are known.

    nodes (k,): numbers.  coefficient (3 k,) N.  factor (3 k, 3 k): lower, L L' is the inverse of
    the covariance.  draws (3 k, DRAWS): deviations as the posterior has them.  scale: what the
    solution speaks for; solved_noise: square of the noise that it was solved for.
    """

    nodes: NDArray[np.intp]
    coefficient: NDArray[np.float64]
    factor: NDArray[np.float64]
    draws: NDArray[np.float64]
    scale: TractionScale
    solved_noise: float

    def covariance(self, functionals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Covariance (j, j) of linear functionals (j, 3 k) of the coefficients."""
        half = forward(self.factor, np.array(functionals.T, dtype=np.float64, order="F"))
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
        # Compiled, or read from numba's cache, before the first frame.
        whole = self._normal, smoothness, np.arange(1)
        _energies(_assembled(*whole, NONE_ABSENT, 1.0, np.ones(3)), _some_of(*whole[1:]))

    def solve(
        self,
        data: NDArray[np.float64],
        known: NDArray[np.bool_],
        nodes: NDArray[np.intp],
        scale: TractionScale,
        rounds: int,
    ) -> TractionPosterior:
        """Posterior given data (m,), in units of the noise, of which the `known` count.

        nodes (k,): where there may be traction.  scale: what to begin with; it settles in as many
        solutions as it takes, at most `rounds`.  Raises GeometryError for no nodes.
        """
        if not len(nodes):
            msg = "nodes: found none, expected at least 1"
            raise GeometryError(msg)
        problem = self._problem(data, known, nodes)
        for _ in range(rounds):
            solution = problem.solution(scale)
            before, scale = scale, problem.settled(solution)
            if scale.is_near(before):
                break
        return replace(solution, scale=scale)

    def again(
        self, posterior: TractionPosterior, data: NDArray[np.float64], known: NDArray[np.bool_]
    ) -> TractionPosterior:
        """The posterior for other data of the same markers, on the same nodes, for the same scale.

        A tenth of the work: all but the coefficients stays.
        """
        pull = self._pull(np.where(known, data, 0.0))[_unknowns(posterior.nodes)]
        right = np.asfortranarray(pull[:, None] / posterior.solved_noise)
        solve(posterior.factor, forward(posterior.factor, right))
        return replace(posterior, coefficient=right[:, 0])

    def _problem(
        self, data: NDArray[np.float64], known: NDArray[np.bool_], nodes: NDArray[np.intp]
    ) -> _Problem:
        unknowns, missing = _unknowns(nodes), np.flatnonzero(~known)
        data = np.where(known, data, 0.0)
        absent = NONE_ABSENT
        if len(missing):
            rows = self._response[missing][:, unknowns]
            absent = np.ascontiguousarray(rows.T @ rows)
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
    """One mask of k nodes: normal equations of what is known, and their prior.

    normal, smoothness: of all nodes.  absent (3 k, 3 k): what is to be taken off for data that
    are not known; empty where all are.
    """

    nodes: NDArray[np.intp]
    normal: NDArray[np.float64]
    smoothness: NDArray[np.float64]
    absent: NDArray[np.float64]
    pull: NDArray[np.float64]
    power: float
    count: int
    noise: NDArray[np.float64]

    @cached_property
    def prior(self) -> NDArray[np.float64]:
        """The smoothness on the mask, (k, k)."""
        return _some_of(self.smoothness, self.nodes)

    def solution(self, scale: TractionScale) -> TractionPosterior:
        """The posterior for one scale."""
        whole = self.normal, self.smoothness, self.nodes
        matrix = _assembled(*whole, self.absent, 1 / scale.noise_squared, scale.weights())
        lower = factor(matrix.T)
        right = np.empty((len(matrix), 1 + self.noise.shape[1]), order="F")
        right[:, 0] = self.pull / scale.noise_squared
        right[:, 1:] = self.noise
        forward(lower, right[:, :1])
        solve(lower, right)
        return TractionPosterior(
            self.nodes, right[:, 0], lower, right[:, 1:], scale, scale.noise_squared
        )

    def settled(self, solution: TractionPosterior) -> TractionScale:
        """The scale that the solution speaks for."""
        columns = np.vstack([solution.coefficient, solution.draws.T])
        energies = _energies(columns, self.prior)
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
def _some_of(matrix: NDArray[np.float64], nodes: NDArray[np.intp]) -> NDArray[np.float64]:
    """Rows and columns of some nodes."""
    some: NDArray[np.float64] = np.empty((len(nodes), len(nodes)))
    for a in range(len(nodes)):
        for b in range(len(nodes)):
            some[a, b] = matrix[nodes[a], nodes[b]]
    return some


@njit(cache=True, nogil=True, error_model="numpy")
def _assembled(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    normal: NDArray[np.float64],
    smoothness: NDArray[np.float64],
    nodes: NDArray[np.intp],
    absent: NDArray[np.float64],
    scale: float,
    weights: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Upper triangle of scale * (normal - absent) + weights * smoothness on some nodes."""
    count = len(nodes)
    total: NDArray[np.float64] = np.empty((3 * count, 3 * count))
    for a in range(count):
        for c in range(3):
            row, source = total[3 * a + c], normal[3 * nodes[a] + c]
            for b in range(a, count):
                first = 3 * nodes[b]
                for d in range(3):
                    row[3 * b + d] = scale * source[first + d]
                row[3 * b + c] += weights[c] * smoothness[nodes[a], nodes[b]]
            if len(absent) > 0:
                for k in range(3 * a + c, 3 * count):
                    row[k] -= scale * absent[3 * a + c, k]
    return total


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _energies(columns: NDArray[np.float64], smoothness: NDArray[np.float64]) -> NDArray[np.float64]:
    """x' P x of the components (3,) of fields (j, 3 k), as (3, j)."""
    count = len(smoothness)
    found: NDArray[np.float64] = np.zeros((3, len(columns)))
    x, y, z = np.empty(count), np.empty(count), np.empty(count)
    for j in range(len(columns)):
        for a in range(count):
            x[a], y[a], z[a] = columns[j, 3 * a], columns[j, 3 * a + 1], columns[j, 3 * a + 2]
        for a in range(count):
            row = smoothness[a]
            p, q, r = 0.0, 0.0, 0.0
            for b in range(count):
                p += row[b] * x[b]
                q += row[b] * y[b]
                r += row[b] * z[b]
            found[0, j] += p * x[a]
            found[1, j] += q * y[a]
            found[2, j] += r * z[a]
    return found
