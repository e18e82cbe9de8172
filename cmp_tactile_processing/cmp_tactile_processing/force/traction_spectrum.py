"""First pass: the traction on the whole surface, its smoothness chosen by the evidence.

Expected of a traction before any marker has moved: it is smooth, and mostly normal.  The unknowns
are coefficients: node j's coefficient, in N, is spread over the surface as a bilinear hat.  What
belongs to a node is the integral of the traction times that node's own hat, the consistent nodal
force of finite elements, which is what any other discretisation of the same traction gives as
well; the coefficients alone are not.

In the generalised eigenvectors of data and prior the regularised inverse is a filter of
coefficients, so that its weight is chosen again for every frame at no cost.  A block that is its
own mirror image falls into four parts by parity, each a quarter of the whole in size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import eigh

from cmp_tactile_processing.elastic.mirror_symmetry import (
    PARITIES,
    Parity,
    PartProducts,
    Rows,
    SparseRows,
    product_of_parts,
    sparse_product,
)
from cmp_tactile_processing.measured import SurfaceGrid

# The noise is never taken for less than this share of what the parameters say, squared.
MIN_NOISE_SQUARED = 0.05**2
# A tangential traction is expected to be so large a share of the normal one: a usual friction.
TANGENTIAL_SHARE = 0.5

# Weights that are tried, relative to the largest eigenvalue.
WEIGHTS = np.logspace(-9, 1, 51)
# Missing data: the filled-in values settle in so many steps at most, to this share of the noise.
FILL_STEPS, FILL_TOLERANCE = 40, 0.05


def nodal_force_matrix(nodes: SurfaceGrid) -> NDArray[np.float64]:
    """Matrix (n, n) from coefficients to consistent nodal forces, the same for every component.

    Each column sums to 1: what a hat at the edge spreads beyond the grid stays with its node.
    """
    lines = []
    for count in (nodes.rows, nodes.cols):
        line = _mass(count)
        line[np.diag_indices(count)] += 1 - line.sum(axis=0)
        lines.append(line)
    return np.asarray(np.kron(lines[0], lines[1]), np.float64)


def smoothness(nodes: SurfaceGrid, length: float) -> NDArray[np.float64]:
    """Precision (n, n) of one component's coefficients, of variance 1 in the middle of the grid.

    That of a Matern field, (1 - length^2 Laplace)^2, in the space of the hats, with a traction
    that falls to zero outside: restricted to some nodes it is the precision given that all other
    coefficients vanish (Lindgren, Rue and Lindstroem 2011).  length: m.
    """
    parts = []
    for count, spacing in ((nodes.rows, nodes.spacing[1]), (nodes.cols, nodes.spacing[0])):
        slope = 2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
        parts.append((_mass(count), slope * (length / spacing) ** 2))
    (mass_y, slope_y), (mass_x, slope_x) = parts
    mass = np.kron(mass_y, mass_x)
    operator = mass + np.kron(slope_y, mass_x) + np.kron(mass_y, slope_x)
    precision = operator @ np.linalg.solve(mass, operator)
    middle = (nodes.rows // 2) * nodes.cols + nodes.cols // 2
    unit = np.zeros(len(precision))
    unit[middle] = 1.0
    return np.asarray(precision * np.linalg.solve(precision, unit)[middle])


def gradient_penalty(nodes: SurfaceGrid, length: float) -> NDArray[np.float64]:
    """Integral of |t|^2 + length^2 |grad t|^2 over the coefficients, (3 n, 3 n) 1/m^2.

    t is the traction of coefficients of 1 N, which falls to zero one spacing outside the grid;
    length: m.
    """
    slopes = [
        (2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)) * (length / spacing) ** 2
        for count, spacing in zip((nodes.rows, nodes.cols), nodes.spacing[::-1], strict=True)
    ]
    mass_y, mass_x = _mass(nodes.rows), _mass(nodes.cols)
    one = np.kron(mass_y, mass_x) + np.kron(slopes[0], mass_x) + np.kron(mass_y, slopes[1])
    return np.asarray(np.kron(one / (nodes.spacing[0] * nodes.spacing[1]), np.eye(3)))


def _mass(count: int) -> NDArray[np.float64]:
    """Integrals of products of neighbouring hats, over their spacing."""
    return np.asarray(2 / 3 * np.eye(count) + (np.eye(count, k=1) + np.eye(count, k=-1)) / 6)


@dataclass(frozen=True)
class FirstPass:
    """What the first pass found.

    coefficient (n,) N; data (m,): with the missing ones filled in, in units of the noise;
    noise_squared: of the data over what the parameters say; weight: of the prior, relative;
    evidence: logarithm of how much likelier some traction is than none.
    nodal_std (nodes,): of the consistent nodal force along z that noise alone causes, N.
    """

    coefficient: NDArray[np.float64]
    data: NDArray[np.float64]
    noise_squared: float
    weight: float
    evidence: float
    nodal_std: NDArray[np.float64]


class _Part:
    """One parity's share of the problem."""

    def __init__(
        self,
        parity: Parity,
        grids: tuple[SurfaceGrid, SurfaceGrid],
        response: NDArray[np.float64],
        precision: NDArray[np.float64],
        nodal: sparse.csr_array,
    ) -> None:
        self.of_markers, self.of_nodes = (
            parity.orthonormal(grid.rows, grid.cols) for grid in grids
        )
        part = np.ascontiguousarray(self.of_markers.T @ response @ self.of_nodes)
        prior = self.of_nodes.T @ precision @ self.of_nodes
        values, vectors = eigh(part.T @ part, prior, check_finite=False)
        self.response = part
        self.values = np.maximum(values, 0.0)
        self.vectors = np.ascontiguousarray(vectors)
        self.analysis = np.ascontiguousarray(vectors.T @ part.T)
        along_z = sparse.csr_array((nodal @ self.of_nodes)[2::3])
        quarter = _quarter(grids[1])[0]
        self.nodal_squares = np.asarray(along_z[quarter] @ vectors) ** 2


class TractionSpectrum:
    """f with the smallest |G f - d|^2 + weight f' P f, for the weight of greatest evidence.

    response G: (3 markers, 3 nodes), markers' displacement in units of its noise per N, the same
    noise at each marker.  precision P (3 nodes, 3 nodes).  nodal: consistent nodal forces from
    coefficients, (3 nodes, 3 nodes).
    """

    def __init__(
        self,
        markers: SurfaceGrid,
        nodes: SurfaceGrid,
        response: NDArray[np.float64],
        precision: NDArray[np.float64],
        nodal: sparse.csr_array,
    ) -> None:
        parts = [_Part(p, (markers, nodes), response, precision, nodal) for p in PARITIES]
        self._parts = parts
        to_markers = sparse.hstack([part.of_markers for part in parts])
        to_nodes = sparse.hstack([part.of_nodes for part in parts])
        from_markers, self._from_nodes = SparseRows(to_markers.T), SparseRows(to_nodes.T)
        onto_markers, onto_nodes = SparseRows(to_markers), SparseRows(to_nodes)
        of_parts = [part.response for part in parts]
        # For what a solution leaves over 1e-7 of it will do, in half the time.
        self._respond = PartProducts(self._from_nodes, _single(of_parts), onto_markers)
        self._pull = PartProducts(from_markers, [part.T for part in of_parts], onto_nodes)
        self._at_nodes = _slices([part.of_nodes.shape[1] for part in parts])
        self.values = np.concatenate([part.values for part in parts])
        self.scale = float(self.values.max())
        weights = WEIGHTS[:, None] * self.scale
        shrink = 1 / (self.values + weights)
        self._modes = _Modes(
            from_markers.rows,
            onto_markers.rows,
            onto_nodes.rows,
            tuple(part.analysis for part in parts),
            _single([part.vectors for part in parts]),
            _single([part.nodal_squares for part in parts]),
            _quarter(nodes)[1],
            self.values,
            shrink,
            0.5 * np.log(weights * shrink).sum(axis=1),
        )
        # Compiled, or read from numba's cache, before the first frame.
        count = 3 * markers.rows * markers.cols
        self.solve(np.zeros(count), np.ones(count, dtype=bool))

    def solve(
        self,
        data: NDArray[np.float64],
        known: NDArray[np.bool_],
        weight: float | None = None,
    ) -> FirstPass:
        """First pass over data (m,), in units of the noise, of which only the `known` count.

        weight: relative; chosen by the evidence where it is not given.
        """
        index = -1 if weight is None else int(np.argmin(np.abs(np.log(WEIGHTS / weight))))
        found = _first_pass(self._modes, data, known, index)
        coefficient, data, noise, index, evidence, nodal_std = found
        return FirstPass(coefficient, data, noise, float(WEIGHTS[index]), evidence, nodal_std)

    def respond(self, coefficient: NDArray[np.float64]) -> NDArray[np.float64]:
        """G f: data (m,) that coefficients (n,) cause."""
        return self._respond.of_vector(coefficient)

    def pull(self, data: NDArray[np.float64]) -> NDArray[np.float64]:
        """G' d: what data (m,) ask of the coefficients, (n,)."""
        return self._pull.of_vector(data)

    def noise_covariance(
        self, functionals: NDArray[np.float64], weight: float
    ) -> NDArray[np.float64]:
        """Covariance (j, j) of functionals (j, n) of the coefficients by noise of 1 alone."""
        folded = self._from_nodes.of_columns(functionals.T)
        parts = zip(self._parts, self._at_nodes, strict=True)
        of_modes = np.concatenate([part.vectors.T @ folded[place] for part, place in parts])
        half = of_modes * (np.sqrt(self.values) / (self.values + weight * self.scale))[:, None]
        return np.asarray(half.T @ half)


class _Modes(NamedTuple):
    """The generalised eigenvectors of data and prior, n of them, part by part.

    from_markers, onto_markers, onto_nodes: between the grids and the parts.  analysis: from data to
    modes; vectors: from modes to coefficients; nodal_squares: from the modes' variances to those of
    the nodal forces along z on a quarter, of_quarter (nodes,): its points.  values (n,).
    shrink (w, n), log_prior (w,): of the weights.
    """

    from_markers: Rows
    onto_markers: Rows
    onto_nodes: Rows
    analysis: tuple[NDArray[np.float64], ...]
    vectors: tuple[NDArray[np.float32], ...]
    nodal_squares: tuple[NDArray[np.float32], ...]
    of_quarter: NDArray[np.intp]
    values: NDArray[np.float64]
    shrink: NDArray[np.float64]
    log_prior: NDArray[np.float64]


@njit(cache=True, nogil=True, error_model="numpy")
def _first_pass(
    of: _Modes, data: NDArray[np.float64], known: NDArray[np.bool_], index: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, int, float, NDArray[np.float64]]:
    """Coefficients, filled data, noise, number of the weight, evidence and nodal deviations.

    index: of the weight; below 0 it is chosen by the evidence.
    """
    data = np.where(known, data, 0.0)
    count, total, is_given = int(known.sum()), np.dot(data, data), index >= 0
    modes = _analysed(of, data)
    if not is_given:
        index = _likeliest_weight(of, np.dot(data, data), modes, count)
    if count < len(data):
        data = _filled(of, data, known, index)
        modes = _analysed(of, data)
        if not is_given:
            index = _likeliest_weight(of, np.dot(data, data), modes, count)
    gain = of.shrink[index]
    misfit = max(np.dot(data, data) - np.dot(gain, modes**2), 0.0)
    noise = max(misfit / count, MIN_NOISE_SQUARED)
    variance = _summed(of.nodal_squares, noise * of.values * gain**2)
    nothing = _log_evidence(total, max(total / count, MIN_NOISE_SQUARED), count)
    evidence = _log_evidence(misfit, noise, count) + of.log_prior[index] - nothing
    coefficient = sparse_product(of.onto_nodes, product_of_parts(of.vectors, gain * modes))
    return coefficient, data, noise, index, evidence, np.sqrt(variance[of.of_quarter])


@njit(cache=True, nogil=True, error_model="numpy")
def _analysed(of: _Modes, data: NDArray[np.float64]) -> NDArray[np.float64]:
    return product_of_parts(of.analysis, sparse_product(of.from_markers, data))


@njit(cache=True, nogil=True, error_model="numpy")
def _likeliest_weight(of: _Modes, power: float, modes: NDArray[np.float64], count: int) -> int:
    """Number of the weight of greatest evidence; power: the data's square."""
    fitted = np.dot(of.shrink, modes**2)
    best, likeliest = 0, -np.inf
    for index in range(len(fitted)):
        misfit = max(power - fitted[index], 0.0)
        noise = max(misfit / count, MIN_NOISE_SQUARED)
        evidence = _log_evidence(misfit, noise, count) + of.log_prior[index]
        if evidence > likeliest:
            best, likeliest = index, evidence
    return best


@njit(cache=True, nogil=True, error_model="numpy")
def _filled(
    of: _Modes, data: NDArray[np.float64], known: NDArray[np.bool_], index: int
) -> NDArray[np.float64]:
    """Missing data as the solution itself predicts them, which is to leave them out.

    The fit then pulls nowhere at the missing data (leave-out formula of linear smoothers);
    the system for them, 1 - H with H the smoother, is solved by conjugate gradients.
    """
    gain = of.shrink[index]
    residual = _smooth_at_missing(of, gain, data, known)
    direction, power = residual, np.dot(residual, residual)
    filled: NDArray[np.float64] = data.copy()
    for _ in range(FILL_STEPS):
        if power <= FILL_TOLERANCE**2 * (len(known) - np.count_nonzero(known)):
            break
        image = direction - _smooth_at_missing(of, gain, direction, known)
        step = power / np.dot(direction, image)
        filled += step * direction
        residual = residual - step * image
        last, power = power, np.dot(residual, residual)
        direction = residual + power / last * direction
    return filled


@njit(cache=True, nogil=True, error_model="numpy")
def _smooth_at_missing(
    of: _Modes, gain: NDArray[np.float64], data: NDArray[np.float64], known: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """What the smoother makes of data at those that are missing, 0 at the others."""
    modes, first, place = gain * _analysed(of, data), 0, 0
    folded: NDArray[np.float64] = np.empty(of.onto_markers.columns.max() + 1)
    for part in of.analysis:
        share = np.dot(modes[first : first + part.shape[0]], part)
        for i in range(len(share)):
            folded[place + i] = share[i]
        first, place = first + part.shape[0], place + part.shape[1]
    return np.where(known, 0.0, sparse_product(of.onto_markers, folded))


@njit(cache=True, nogil=True, error_model="numpy")
def _summed(
    parts: tuple[NDArray[np.float32], ...], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Sum of each part's matrix times its share of the values."""
    total: NDArray[np.float64] = np.zeros(parts[0].shape[0])
    column = 0
    for part in parts:
        total += np.dot(part, values[column : column + part.shape[1]].astype(part.dtype))
        column += part.shape[1]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _log_evidence(misfit: float, noise: float, count: int) -> float:
    evidence: float = -0.5 * (misfit / noise + count * np.log(noise))
    return evidence


def _quarter(grid: SurfaceGrid) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Numbers of the points of a quarter, and of the one of these that each point mirrors."""
    row, col = (np.arange(count) for count in (grid.rows, grid.cols))
    row, col = np.minimum(row, row[::-1]), np.minimum(col, col[::-1])
    mirrored = (row[:, None] * grid.cols + col).ravel()
    points, of_quarter = np.unique(mirrored, return_inverse=True)
    return points, of_quarter


def _single(parts: Sequence[NDArray[np.float64]]) -> tuple[NDArray[np.float32], ...]:
    return tuple(part.astype(np.float32) for part in parts)


def _slices(widths: list[int]) -> list[slice]:
    ends = np.cumsum(widths)
    return [slice(end - width, end) for end, width in zip(ends, widths, strict=True)]
