"""Second pass: the traction on the nodes that are in contact, all others being free of it.

The posterior of a linear model with Gaussian noise and a smooth prior.  How large the normal and
the tangential traction are expected to be, and how large the noise is, follows from the frame
itself (type-II maximum likelihood, MacKay 1992).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
from numba import njit
from numba.extending import get_cython_function_address
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.force.traction_spectrum import MIN_NOISE_SQUARED

# Draws from the posterior that traces and nodal deviations are estimated from: 3 % of a trace.
DRAWS = 32
# So many numbers in draws give how a trace changes: how soon a scale is found, and how uncertain it
# is, to a few percent.
CURVATURE_NUMBERS, MOST_CURVATURE_DRAWS = 2000, 8
# The tangential traction is never expected to be less than this share of the normal one.
MIN_TANGENTIAL = 0.02
# A scale is found when the next step changes no part's logarithm by more than this: the step is
# taken into the coefficients, and what is left is of its square.
SETTLED = 0.25
# Newton's step is taken up to this size; beyond, and where the evidence is not concave, MacKay's.
LONGEST_STEP = 1.5
# So is MacKay's where the logarithm of the squared noise is this far off, which Newton's step goes
# after by one at most.
FAR_NOISE = 0.5
# From the first pass it takes three to five solutions, from the last frame's scale one or two.
MAX_ROUNDS = 12
# Deviation of a weight's logarithm above which the evidence is too flat to show it.
DOUBTFUL = 0.5
# Nodes come into a mask and leave it in threes, as neighbours of one that stands out.
TOGETHER = 3.0
# Share of the last step that need not be taken into the coefficients.
LEFT = 0.02
# Twice the curvature of the log evidence that counts as none: such a scale is known to e^1.4.
LEAST_CURVATURE = 1.0
NONE_ABSENT = np.zeros((0, 0))

Array = NDArray[np.float64]

# Module, name and number of arguments.
POTRF = "scipy.linalg.cython_lapack", "dpotrf", 5
TRSM = "scipy.linalg.cython_blas", "dtrsm", 11


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

    def moved(self, step: NDArray[np.float64]) -> TractionScale:
        """This scale after a step (3,) in the logarithms of tangential and normal weight and noise.

        No part falls below what it is never expected to fall below.
        """
        share = np.exp(step * [-0.5, -0.5, 1.0])
        normal = max(self.normal * share[1], 1e-9)
        tangential = max(self.tangential * share[0], MIN_TANGENTIAL * normal)
        return TractionScale(
            normal, tangential, max(self.noise_squared * share[2], MIN_NOISE_SQUARED)
        )

    def step_to(self, other: TractionScale) -> NDArray[np.float64]:
        """The step (3,) that `moved` takes to the other scale."""
        share = other.over(self)
        parts = np.log([share.tangential, share.normal, share.noise_squared])
        return np.asarray(parts * [-2.0, -2.0, 1.0])


@dataclass(frozen=True)
class TractionPosterior:
    """Coefficients on the nodes of the mask, and how well they are known.

    nodes (k,): numbers.  coefficient (3 k,) N.  factor (3 k, 3 k): lower, L L' is the inverse of
    the covariance for one scale, `solved`.  draws (3 k, DRAWS): deviations as the posterior has
    them.  scale: the likeliest, which the coefficients are for.  drift (3 k, 2): how the
    coefficients change along the two ways in which the scale may be off by its own deviation.
    edge (k,): nodes that a little more noise would have left out of the mask, so that whether they
    bear anything is in doubt.
    """

    nodes: NDArray[np.intp]
    coefficient: NDArray[np.float64]
    factor: NDArray[np.float64]
    draws: NDArray[np.float64]
    scale: TractionScale
    solved: TractionScale
    drift: NDArray[np.float64]
    edge: NDArray[np.bool_] | None = None

    @cached_property
    def _edge_pull(self) -> NDArray[np.float64]:
        """Coefficients of the edge over their variances, which the draws show, (edge, 3)."""
        some = np.repeat(np.asarray(self.edge, dtype=bool), 3)
        pull = self.coefficient[some] / (self.draws[some] ** 2).mean(axis=1)
        return np.asarray(pull.reshape(-1, 3))

    def covariances(
        self, functionals: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Covariance (j, j) of linear functionals (j, 3 k) of the coefficients, for this scale.

        With it what scale and edge leave open on top of that, (j, j).
        """
        half = forward(self.factor, np.array(functionals.T, dtype=np.float64, order="F"))
        for_scale = np.asarray(half.T @ half)
        of_scale = functionals @ self.drift
        doubt = of_scale @ of_scale.T
        if self.edge is not None and self.edge.any():
            lost = self._without_edge(half)
            doubt += TOGETHER * lost.T @ lost
        return for_scale, doubt

    def _without_edge(self, half: NDArray[np.float64]) -> NDArray[np.float64]:
        """How functionals change where a node of the edge is free of traction, (edge, j).

        half (3 k, j): of the functionals.
        """
        spread = solve(self.factor, half).reshape(len(self.nodes), 3, -1)
        return np.asarray(np.einsum("ecj,ec->ej", spread[self.edge], self._edge_pull))


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
        _assembled(*whole, NONE_ABSENT, 1.0, np.ones(3))
        _some_of(*whole[1:])

    def solve(
        self,
        data: NDArray[np.float64],
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
        found, doubt = problem.likeliest(begin or first)
        if doubt > DOUBTFUL and begin is not None:
            # So flat that where the search ends may hang on where it began.
            found, _ = problem.likeliest(first)
        return found

    def posterior(
        self,
        data: NDArray[np.float64],
        known: NDArray[np.bool_],
        nodes: NDArray[np.intp],
        scale: TractionScale,
    ) -> TractionPosterior:
        """The posterior for a scale that is known; all else as in `solve`."""
        return self._problem(data, known, nodes).solution(scale)

    def again(
        self, posterior: TractionPosterior, data: NDArray[np.float64], known: NDArray[np.bool_]
    ) -> TractionPosterior:
        """The posterior for other data of the same markers, on the same nodes, for the same scale.

        A tenth of the work: all but the coefficients stays.
        """
        pull = self._pull(np.where(known, data, 0.0))[_unknowns(posterior.nodes)]
        solved = _solved(posterior.factor, pull / posterior.solved.noise_squared)
        prior = _some_of(self._smoothness, posterior.nodes)
        return replace(posterior, coefficient=_coefficient(posterior, solved, prior))

    def _problem(
        self, data: NDArray[np.float64], known: NDArray[np.bool_], nodes: NDArray[np.intp]
    ) -> _Problem:
        if not len(nodes):
            msg = "nodes: found none, expected at least 1"
            raise GeometryError(msg)
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
            _normalised(self._draws[unknowns]),
        )


@dataclass(frozen=True)
class _Step:
    """Towards the likeliest scale.

    change (3,): for TractionScale.moved.  slope (3 k, 2): of the coefficients in the logarithms of
    the tangential and the normal weight times noise, on which alone they hang.  root (2, 2): of
    the covariance of these logarithms.
    """

    change: NDArray[np.float64]
    slope: NDArray[np.float64]
    root: NDArray[np.float64]


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
        none = np.zeros((len(matrix), 2))
        return TractionPosterior(self.nodes, right[:, 0], lower, right[:, 1:], scale, scale, none)

    def likeliest(self, scale: TractionScale) -> tuple[TractionPosterior, float]:
        """The posterior for the scale that makes the frame likeliest, sought from a scale on.

        With it how uncertain the logarithms of its weights are.
        """
        for _ in range(MAX_ROUNDS):
            solution = self.solution(scale)
            step = self.step(solution)
            scale = scale.moved(step.change)
            if np.abs(solution.scale.step_to(scale)).max() <= SETTLED:
                break
        # Not further than the coefficients can follow, should it never have settled.
        change = np.clip(solution.scale.step_to(scale), -SETTLED, SETTLED)
        doubt = float(np.linalg.norm(step.root, axis=1).max())
        return self._refined(solution, step, solution.scale.moved(change)), doubt

    def step(self, solution: TractionPosterior) -> _Step:
        """How the scale has to change for the frame to be likelier, by Newton's method.

        First and second derivatives of the log evidence; traces are estimated from the draws.
        """
        weights = solution.scale.weights()[1:]
        columns = np.column_stack([solution.coefficient, solution.draws])
        smoothed = self._smoothed(columns)
        products = (columns * smoothed).reshape(len(self.nodes), 3, -1).sum(axis=0)
        energies = weights[:, None] * [products[:2].sum(axis=0), products[2]]
        energy, trace = energies[:, 0], energies[:, 1:].mean(axis=1)
        determined = np.maximum([2 * len(self.nodes), len(self.nodes)] - trace, [2.0, 1.0])
        noise = solution.scale.noise_squared
        # |G f - d|^2 by the normal equations: (G'G) f = G'd - noise * weights * P f.
        misfit = (self.power - solution.coefficient @ self.pull) / noise - energy.sum()
        misfit = max(misfit, MIN_NOISE_SQUARED)
        free = max(self.count - determined.sum(), 0.1 * self.count)

        draws = min(-(-CURVATURE_NUMBERS // len(columns)), MOST_CURVATURE_DRAWS)
        parts = _by_weight(smoothed[:, : 1 + draws], weights)
        half = forward(solution.factor, parts)
        of_force, *of_draws = (
            half[:, i : i + 2].T @ half[:, i : i + 2] for i in range(0, half.shape[1], 2)
        )
        both = np.mean(of_draws, axis=0) + 2 * of_force
        curvature = np.empty((3, 3))
        curvature[:2, :2] = np.diag(trace + energy) - both
        curvature[:2, 2] = curvature[2, :2] = trace - both.sum(axis=1)
        curvature[2, 2] = misfit + trace.sum() - both.sum()
        gradient = np.array([*(determined - energy), misfit - free])
        change, covariance = _newton(gradient, curvature, _ways(solution.scale, gradient))
        mackay = np.log([*(determined / np.maximum(energy, 1e-12)), misfit / free])
        if abs(mackay[2]) > FAR_NOISE or not np.abs(change).max() < LONGEST_STEP:
            change = mackay
        slope = -solve(solution.factor, np.asfortranarray(half[:, :2]))
        return _Step(change, slope, _root(covariance))

    def _refined(
        self, solution: TractionPosterior, step: _Step, scale: TractionScale
    ) -> TractionPosterior:
        """The solution for a scale nearby, with what the doubt about the scale adds."""
        drift = step.slope @ step.root
        draws = solution.draws + drift @ self.noise[:2]
        found = replace(solution, draws=draws, scale=scale, drift=drift)
        change = solution.scale.step_to(scale)
        begin = solution.coefficient + step.slope @ (change[:2] + change[2])
        coefficient = _coefficient(found, solution.coefficient, self.prior, begin)
        return replace(found, coefficient=coefficient)

    def _smoothed(self, columns: NDArray[np.float64]) -> NDArray[np.float64]:
        """P x of fields (3 k, j), component by component."""
        return np.asarray(
            (self.prior @ columns.reshape(len(self.nodes), -1)).reshape(columns.shape)
        )


def _by_weight(fields: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Tangential and normal part of each of the fields (3 k, j), times its weight, (3 k, 2 j)."""
    parts = np.zeros((len(fields), 2 * fields.shape[1]), order="F")
    for component, part in enumerate((0, 0, 1)):
        parts[component::3, part::2] = weights[part] * fields[component::3]
    return parts


def _ways(scale: TractionScale, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
    """The ways (3, j) in which a scale may change: not beyond where it is bound to stay."""
    ways = np.eye(3)
    if scale.noise_squared <= MIN_NOISE_SQUARED and gradient[2] < 0:
        ways = ways[:, :2]
    if scale.tangential <= 1.001 * MIN_TANGENTIAL * scale.normal and gradient[0] > 0:
        ways[0, 1] = 1.0
        ways = ways[:, 1:]
    return ways


def _newton(
    gradient: NDArray[np.float64], curvature: NDArray[np.float64], ways: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Newton's step (3,), NaN where the evidence is not concave, and the scale's covariance.

    gradient, curvature: twice those of the log evidence, the latter negative.
    """
    values, vectors = np.linalg.eigh(ways.T @ curvature @ ways)
    concave = values > LEAST_CURVATURE
    vectors = ways @ vectors
    change = vectors @ (vectors.T @ gradient / values) if concave.all() else np.full(3, np.nan)
    covariance = 2 * (vectors / np.maximum(values, LEAST_CURVATURE)) @ vectors.T
    return change, covariance


def _root(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root (2, 2) of the covariance of weight times noise, from that (3, 3) of a step."""
    both = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    values, vectors = np.linalg.eigh(both @ covariance @ both.T)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _coefficient(
    posterior: TractionPosterior,
    solved: NDArray[np.float64],
    prior: NDArray[np.float64],
    begin: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Coefficients (3 k,) for the posterior's scale, by the factor for a nearby one.

    solved (3 k,): those for the scale of the factor.  begin (3 k,): wrong by the square of the
    change of scale only.
    """
    step = posterior.solved.step_to(posterior.scale)
    change = np.expm1(step[[0, 0, 1]] + step[2])
    weights, size = change * posterior.solved.weights(), float(np.abs(change).max())
    found, left = (solved, size) if begin is None else (begin, size**2)
    while left > LEFT:
        off = (prior @ found.reshape(-1, 3)) * weights
        found = solved - _solved(posterior.factor, off.ravel())
        left *= size
    return found


def _solved(lower: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    column = np.asfortranarray(right[:, None])
    return solve(lower, forward(lower, column))[:, 0]


def _normalised(draws: NDArray[np.float64]) -> NDArray[np.float64]:
    """Draws (3 k, j) with each component's square exactly what it is expected to be.

    Where the data say little of many coefficients, the few that they fix would else be lost in
    the scatter of the others.
    """
    parts = draws.reshape(-1, 3, draws.shape[1])
    return np.asarray(parts / np.sqrt((parts**2).mean(axis=0))).reshape(draws.shape)


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


def factor(matrix: Array) -> Array:
    """Turn the lower triangle of a matrix (n, n), columns contiguous, into L with L L' = matrix.

    Returns the same array; above the diagonal nothing is read or written.  Raises GeometryError
    for a matrix that is not definite.
    """
    size, info = ctypes.c_int(_checked(matrix, "matrix")), ctypes.c_int(0)
    _function(*POTRF)(
        b"L", ctypes.byref(size), matrix.ctypes.data, *map(ctypes.byref, (size, info))
    )
    if info.value:
        msg = f"matrix: found one that is not definite at unknown {info.value}"
        raise GeometryError(msg)
    return matrix


def forward(lower: Array, right: Array) -> Array:
    """L^-1 right, in the place of right (n, k), columns contiguous; lower L from `factor`."""
    return _triangular(lower, right, b"N")


def solve(lower: Array, right: Array) -> Array:
    """L'^-1 right, in the place of right (n, k), columns contiguous; lower L from `factor`."""
    return _triangular(lower, right, b"T")


def _triangular(lower: Array, right: Array, transposed: bytes) -> Array:
    size = _checked(lower, "lower")
    if right.ndim != 2 or len(right) != size or not _is_plain(right):
        raise _wrong("right", right, f"({size}, k)")
    rows, columns = ctypes.c_int(size), ctypes.c_int(right.shape[1])
    call, (n, k), scale = _function(*TRSM), map(ctypes.byref, (rows, columns)), ctypes.c_double(1.0)
    one = ctypes.byref(scale)
    call(b"L", b"L", transposed, b"N", n, k, one, lower.ctypes.data, n, right.ctypes.data, n)
    return right


def _checked(matrix: Array, name: str) -> int:
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or not _is_plain(matrix):
        raise _wrong(name, matrix, "(n, n)")
    return len(matrix)


def _is_plain(matrix: Array) -> bool:
    """Whether its memory is what LAPACK takes it for: of another type it would write beyond it."""
    return bool(matrix.dtype == np.float64 and matrix.flags.f_contiguous)


def _wrong(name: str, found: Array, shape: str) -> GeometryError:
    return GeometryError(
        f"{name}: found shape {found.shape} of {found.dtype}, "
        f"expected {shape} of float64 with contiguous columns"
    )


@cache
def _function(module: str, name: str, arguments: int) -> Any:
    """A function that takes all its arguments by address, as Fortran has it."""
    kind = ctypes.CFUNCTYPE(None, *(ctypes.c_void_p,) * arguments)
    return kind(get_cython_function_address(module, name))
