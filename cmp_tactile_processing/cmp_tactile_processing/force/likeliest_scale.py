"""Search for the likeliest scale of a contact's traction, and the posterior for it, compiled.

The posterior of a linear model with Gaussian noise and a smooth prior; how large the tractions and
the noise are expected to be is found by type-II maximum likelihood (MacKay 1992).  A whole search
is one compiled call without Python's lock.  Scales are arrays (3,): expected size of the tangential
and of the normal coefficients, N, and squared noise of the data.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cmp_tactile_processing.force.positive_definite import Array, backward, factor, forward
from cmp_tactile_processing.force.traction_spectrum import MIN_NOISE_SQUARED

# So many numbers in draws give how a trace changes: how soon a scale is found, and how uncertain it
# is, to a few percent.
CURVATURE_NUMBERS, MOST_CURVATURE_DRAWS = 2000, 8
# The tangential traction is never expected to be less than this share of the normal one.
MIN_TANGENTIAL = 0.02
MIN_NORMAL = 1e-9
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
# Share of the last step that need not be taken into the coefficients.
LEFT = 0.02
# Twice the curvature of the log evidence that counts as none: such a scale is known to e^1.4.
LEAST_CURVATURE = 1.0
# Which part of a scale holds for the three components.
PART = (0, 0, 1)


class Problem(NamedTuple):
    """Normal equations on the nodes of a mask (k,), of what is known, and their prior.

    normal (3 nodes, 3 nodes), smoothness (nodes, nodes): of all nodes.  absent (3 k, 3 k): what is
    to be taken off for data that are not known; empty where all are.  pull (3 k,): of the data.
    power: the data's square.  known: how many data are.  draws (draws, 3 k).
    """

    normal: Array
    smoothness: Array
    nodes: NDArray[np.intp]
    absent: Array
    pull: Array
    power: float
    known: int
    draws: Array


class Solution(NamedTuple):
    """The posterior for one scale: upper (3 k, 3 k), R' R is the inverse of the covariance.

    right (1 + draws, 3 k): coefficients, then deviations as the posterior has them.
    """

    scale: Array
    upper: Array
    right: Array


class Likeliest(NamedTuple):
    """The posterior for the likeliest scale, by the solution for one nearby.

    drift (3 k, 2): how coefficients change along the two ways in which the scale may be off by its
    own deviation.  doubt: about the logarithms of its weights.
    """

    solved: Solution
    scale: Array
    right: Array
    drift: Array
    doubt: float


@njit(cache=True, nogil=True, error_model="numpy")
def search(problem: Problem, begin: Array) -> Likeliest:
    """The posterior for the scale that makes the frame likeliest, sought from a scale on."""
    prior = _some_of(problem.smoothness, problem.nodes)
    scale = begin
    for _ in range(MAX_ROUNDS):
        solution = solve(problem, scale)
        change, slope, root = _step(problem, prior, solution)
        scale = _moved(solution.scale, change)
        if _largest(_step_to(solution.scale, scale)) <= SETTLED:
            break
    # Not further than the coefficients can follow, should it never have settled.
    change = np.minimum(np.maximum(_step_to(solution.scale, scale), -SETTLED), SETTLED)
    doubt = max(np.hypot(root[0, 0], root[0, 1]), np.hypot(root[1, 0], root[1, 1]))
    return _refined(problem, prior, solution, _moved(solution.scale, change), slope, root, doubt)


@njit(cache=True, nogil=True, error_model="numpy")
def solve(problem: Problem, scale: Array) -> Solution:
    """The posterior for one scale."""
    upper = _assembled(problem, 1 / scale[2], scale[:2] ** -2.0)
    factor(upper)
    right: Array = np.empty((1 + len(problem.draws), len(upper)))
    for column in range(len(upper)):
        right[0, column] = problem.pull[column] / scale[2]
        for row in range(1, len(right)):
            right[row, column] = problem.draws[row - 1, column]
    forward(upper, right[:1])
    backward(upper, right)
    return Solution(scale, upper, right)


@njit(cache=True, nogil=True, error_model="numpy")
def solve_again(
    solution: Solution, scale: Array, pull: Array, smoothness: Array, nodes: NDArray[np.intp]
) -> Array:
    """Coefficients (3 k,) for other data, of this pull, by the factor for a nearby scale."""
    solved: Array = np.empty((1, len(pull)))
    for i in range(len(pull)):
        solved[0, i] = pull[i] / solution.scale[2]
    forward(solution.upper, solved)
    backward(solution.upper, solved)
    prior = _some_of(smoothness, nodes)
    return _follow(solution, scale, solved[0], prior, solved[0], False)


@njit(cache=True, nogil=True, error_model="numpy")
def _step(problem: Problem, prior: Array, solution: Solution) -> tuple[Array, Array, Array]:
    """How the scale has to change for the frame to be likelier, by Newton's method.

    First and second derivatives of the log evidence; traces are estimated from the draws.  Returns
    the step (3,), the slope (2, 3 k) of the coefficients in the logarithms of the tangential and
    the normal weight times noise, on which alone they hang, and the root (2, 2) of the covariance
    of these logarithms.
    """
    scale, weights = solution.scale, solution.scale[:2] ** -2.0
    nodes, noise = len(problem.nodes), solution.scale[2]
    smoothed = _smoothed(prior, solution.right)
    energies = _energies(solution.right, smoothed, weights)
    energy, trace = energies[:, 0].copy(), np.empty(2)
    for part in range(2):
        trace[part] = energies[part, 1:].mean()
    determined = np.array([max(2 * nodes - trace[0], 2.0), max(nodes - trace[1], 1.0)])
    # |G f - d|^2 by the normal equations: (G'G) f = G'd - noise * weights * P f.
    misfit = (problem.power - np.dot(solution.right[0], problem.pull)) / noise - energy.sum()
    misfit = max(misfit, MIN_NOISE_SQUARED)
    free = max(problem.known - determined.sum(), 0.1 * problem.known)

    draws = min(-(-CURVATURE_NUMBERS // (3 * nodes)), MOST_CURVATURE_DRAWS)
    half = _by_weight(smoothed, weights, 1 + draws)
    forward(solution.upper, half)
    both = np.zeros((2, 2))
    for row in range(0, len(half), 2):
        share = 2.0 if row == 0 else 1.0 / draws
        for i in range(2):
            for j in range(2):
                both[i, j] += share * np.dot(half[row + i], half[row + j])
    curvature = np.empty((3, 3))
    for i in range(2):
        for j in range(2):
            curvature[i, j] = -both[i, j]
        curvature[i, i] += trace[i] + energy[i]
        curvature[i, 2] = curvature[2, i] = trace[i] - both[i, 0] - both[i, 1]
    curvature[2, 2] = misfit + trace.sum() - both.sum()
    gradient = np.array([determined[0] - energy[0], determined[1] - energy[1], misfit - free])
    change, covariance = _newton(gradient, curvature, _ways(scale, gradient))
    mackay = np.log(
        np.array([determined[0] / max(energy[0], 1e-12), determined[1] / max(energy[1], 1e-12),
                  misfit / free])
    )  # fmt: skip
    if abs(mackay[2]) > FAR_NOISE or not _largest(change) < LONGEST_STEP:
        change = mackay
    slope = -half[:2]
    backward(solution.upper, slope)
    return change, slope, _root(covariance)


@njit(cache=True, nogil=True, error_model="numpy")
def _refined(  # noqa: PLR0913, PLR0917 - flat, as the compiler wants it
    problem: Problem,
    prior: Array,
    solution: Solution,
    scale: Array,
    slope: Array,
    root: Array,
    doubt: float,
) -> Likeliest:
    """The solution for a scale nearby, with what the doubt about the scale adds."""
    drift = np.dot(np.ascontiguousarray(slope.T), root)
    right = solution.right.copy()
    for row in range(1, len(right)):
        for i in range(right.shape[1]):
            right[row, i] += (
                drift[i, 0] * problem.draws[row - 1, 0] + drift[i, 1] * problem.draws[row - 1, 1]
            )
    change = _step_to(solution.scale, scale)
    begin = solution.right[0].copy()
    for part in range(2):
        begin += (change[part] + change[2]) * slope[part]
    coefficient = _follow(solution, scale, solution.right[0], prior, begin, True)
    for i in range(right.shape[1]):
        right[0, i] = coefficient[i]
    return Likeliest(solution, scale, right, drift, doubt)


@njit(cache=True, nogil=True, error_model="numpy")
def _follow(  # noqa: PLR0913, PLR0917 - flat, as the compiler wants it
    solution: Solution, scale: Array, coefficient: Array, prior: Array, begin: Array, is_near: bool
) -> Array:
    """Coefficients (3 k,) for a scale, by the factor of a nearby one.

    coefficient (3 k,): those for the scale of the factor.  begin (3 k,): where to begin; is_near:
    wrong by the square of the change of scale only.
    """
    step = _step_to(solution.scale, scale)
    weights = solution.scale[:2] ** -2.0
    change = np.array([np.expm1(step[part] + step[2]) for part in PART])
    size = _largest(change)
    found, left = begin, size**2 if is_near else size
    while left > LEFT:
        off = np.dot(prior, found.copy().reshape(-1, 3))
        rest: Array = np.empty((1, len(found)))
        for i in range(len(found)):
            rest[0, i] = off[i // 3, i % 3] * change[i % 3] * weights[PART[i % 3]]
        forward(solution.upper, rest)
        backward(solution.upper, rest)
        found = coefficient - rest[0]
        left *= size
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _moved(scale: Array, step: Array) -> Array:
    """A scale after a step (3,) in the logarithms of tangential and normal weight and noise.

    No part falls below what it is never expected to fall below.
    """
    normal = max(scale[1] * np.exp(-0.5 * step[1]), MIN_NORMAL)
    tangential = max(scale[0] * np.exp(-0.5 * step[0]), MIN_TANGENTIAL * normal)
    return np.array([tangential, normal, max(scale[2] * np.exp(step[2]), MIN_NOISE_SQUARED)])


@njit(cache=True, nogil=True, error_model="numpy")
def _step_to(scale: Array, other: Array) -> Array:
    """The step (3,) that `_moved` takes from a scale to another."""
    step: Array = np.log(other / scale) * np.array([-2.0, -2.0, 1.0])
    return step


@njit(cache=True, nogil=True, error_model="numpy")
def _largest(step: Array) -> float:
    """The largest size of its parts, NaN where one is."""
    return float(np.abs(step).max())


@njit(cache=True, nogil=True, error_model="numpy")
def _smoothed(prior: Array, rows: Array) -> Array:
    """P x of fields (j, 3 k), component by component, (k, j, 3)."""
    nodes = len(prior)
    columns: Array = np.empty((nodes, len(rows), 3))
    for row in range(len(rows)):
        for node in range(nodes):
            for c in range(3):
                columns[node, row, c] = rows[row, 3 * node + c]
    products: Array = np.dot(prior, columns.reshape(nodes, -1))
    return products.reshape(nodes, len(rows), 3)


@njit(cache=True, nogil=True, error_model="numpy")
def _energies(rows: Array, smoothed: Array, weights: Array) -> Array:
    """Tangential and normal part of the fields' energies in their prior, (2, j)."""
    energies: Array = np.zeros((2, len(rows)))
    for row in range(len(rows)):
        for node in range(len(smoothed)):
            for c in range(3):
                part = PART[c]
                product = rows[row, 3 * node + c] * smoothed[node, row, c]
                energies[part, row] += weights[part] * product
    return energies


@njit(cache=True, nogil=True, error_model="numpy")
def _by_weight(smoothed: Array, weights: Array, count: int) -> Array:
    """Tangential and normal part of each of some fields, times its weight, (2 count, 3 k)."""
    parts: Array = np.zeros((2 * count, 3 * len(smoothed)))
    for row in range(count):
        for node in range(len(smoothed)):
            for c in range(3):
                part = PART[c]
                parts[2 * row + part, 3 * node + c] = weights[part] * smoothed[node, row, c]
    return parts


@njit(cache=True, nogil=True, error_model="numpy")
def _ways(scale: Array, gradient: Array) -> Array:
    """The ways (3, j) in which a scale may change: not beyond where it is bound to stay."""
    ways = np.eye(3)
    if scale[2] <= MIN_NOISE_SQUARED and gradient[2] < 0:
        ways = ways[:, :2].copy()
    if scale[0] <= 1.001 * MIN_TANGENTIAL * scale[1] and gradient[0] > 0:
        ways[0, 1] = 1.0
        ways = ways[:, 1:].copy()
    return ways


@njit(cache=True, nogil=True, error_model="numpy")
def _newton(gradient: Array, curvature: Array, ways: Array) -> tuple[Array, Array]:
    """Newton's step (3,), NaN where the evidence is not concave, and the scale's covariance.

    gradient, curvature: twice those of the log evidence, the latter negative.
    """
    across = np.ascontiguousarray(ways.T)
    values, vectors = np.linalg.eigh(np.dot(np.dot(across, curvature), ways))
    vectors = np.dot(ways, np.ascontiguousarray(vectors))
    change, covariance = np.zeros(3), np.zeros((3, 3))
    for k in range(len(values)):
        along = 0.0
        for i in range(3):
            along += vectors[i, k] * gradient[i]
        least = max(values[k], LEAST_CURVATURE)
        for i in range(3):
            change[i] += vectors[i, k] * along / values[k]
            if not values[k] > LEAST_CURVATURE:
                change[i] = np.nan
            for j in range(3):
                covariance[i, j] += 2 * vectors[i, k] * vectors[j, k] / least
    return change, covariance


@njit(cache=True, nogil=True, error_model="numpy")
def _root(covariance: Array) -> Array:
    """Root (2, 2) of the covariance of weight times noise, from that (3, 3) of a step."""
    both = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    square = np.dot(np.dot(both, covariance), np.ascontiguousarray(both.T))
    values, vectors = np.linalg.eigh(square)
    return np.ascontiguousarray(vectors * np.sqrt(np.maximum(values, 0.0)))


@njit(cache=True, nogil=True, error_model="numpy")
def _some_of(matrix: Array, nodes: NDArray[np.intp]) -> Array:
    """Rows and columns of some nodes."""
    some: Array = np.empty((len(nodes), len(nodes)))
    for a in range(len(nodes)):
        for b in range(len(nodes)):
            some[a, b] = matrix[nodes[a], nodes[b]]
    return some


@njit(cache=True, nogil=True, error_model="numpy")
def _assembled(problem: Problem, scale: float, weights: Array) -> Array:
    """Upper triangle of scale * (normal - absent) + weights * smoothness on the nodes."""
    nodes, count = problem.nodes, len(problem.nodes)
    total: Array = np.empty((3 * count, 3 * count))
    for a in range(count):
        for c in range(3):
            row, source = total[3 * a + c], problem.normal[3 * nodes[a] + c]
            for b in range(a, count):
                first = 3 * nodes[b]
                for d in range(3):
                    row[3 * b + d] = scale * source[first + d]
                row[3 * b + c] += weights[PART[c]] * problem.smoothness[nodes[a], nodes[b]]
            if len(problem.absent) > 0:
                for k in range(3 * a + c, 3 * count):
                    row[k] -= scale * problem.absent[3 * a + c, k]
    return total
