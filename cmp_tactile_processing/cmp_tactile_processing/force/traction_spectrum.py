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

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import eigh

from cmp_tactile_processing.elastic.mirror_symmetry import (
    PARITIES,
    Fold,
    MirroredProduct,
    Parity,
    SparseRows,
    product_of_parts,
)
from cmp_tactile_processing.measured import SurfaceGrid

Array = NDArray[np.float64]

# The noise is never taken for less than this share of what the parameters say, squared.
MIN_NOISE_SQUARED = 0.05**2
# A tangential traction is expected to be so large a share of the normal one: a usual friction.
TANGENTIAL_SHARE = 0.5

# Weights that are tried, relative to the largest eigenvalue.
WEIGHTS = np.logspace(-9, 1, 51)
# Steps in which the values filled in for missing data settle, to this share of the noise.
MAX_FILL_STEPS = 40
FILL_TOLERANCE_NOISE = 0.05


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


def _mass(count: int) -> NDArray[np.float64]:
    """Integrals of products of neighbouring hats, over their spacing."""
    return np.asarray(2 / 3 * np.eye(count) + (np.eye(count, k=1) + np.eye(count, k=-1)) / 6)


@dataclass(frozen=True)
class TractionScale:
    """Expected size of normal and tangential coefficients, N."""

    normal: float
    tangential: float


@dataclass(frozen=True)
class FirstPass:
    """What the first pass found.

    coefficient (n,) N; data (m,): with the missing ones filled in, in units of the noise;
    noise_squared: of the data over what the parameters say; weight: of the prior, relative;
    evidence: logarithm of how much likelier some traction is than none.
    nodal_std (nodes,): of the consistent nodal force along z that noise alone causes, N.
    """

    coefficient: Array
    data: Array
    noise_squared: float
    weight: float
    evidence: float
    nodal_std: Array


class _Part:
    """One parity's share of the problem."""

    def __init__(
        self,
        parity: Parity,
        grids: tuple[SurfaceGrid, SurfaceGrid],
        response: Array,
        smooth: tuple[sparse.csr_array, sparse.csr_array],
        nodal: sparse.csr_array,
    ) -> None:
        self.of_markers, self.of_nodes = (
            parity.orthonormal(grid.rows, grid.cols) for grid in grids
        )
        self.response = part = np.ascontiguousarray(self.of_markers.T @ response @ self.of_nodes)
        self.tangential, self.normal = (
            (self.of_nodes.T @ matrix @ self.of_nodes).toarray() for matrix in smooth
        )
        self.gram = part.T @ part
        prior = self.tangential / TANGENTIAL_SHARE**2 + self.normal
        values, vectors = eigh(self.gram, prior, check_finite=False)
        self.values = np.maximum(values, 0.0)
        self.vectors = np.ascontiguousarray(vectors)
        self.modes_of_data = np.ascontiguousarray(part @ vectors)
        # Every mode has energy 1 in the prior; so much of it is of the normal traction.
        self.normal_share = np.einsum("ik,ik->k", vectors, self.normal @ vectors)
        quarter = _quarter(grids[1])[0]
        rows = (3 * quarter[:, None] + np.arange(3)).ravel()
        self.nodal_squares = np.asarray((nodal @ self.of_nodes)[rows] @ vectors) ** 2


class TractionSpectrum:
    """f with the smallest |G f - d|^2 + weight f' P f, for the weight of greatest evidence.

    response G: (3 markers, 3 nodes), markers' displacement in units of its noise per N, the same
    noise at each marker.  smoothness (nodes, nodes): precision of one component of the
    coefficients; P is that of the normal one, and over TANGENTIAL_SHARE^2 that of the tangential
    ones.  lumped (nodes, nodes): from coefficients to consistent nodal forces.
    """

    def __init__(
        self,
        markers: SurfaceGrid,
        nodes: SurfaceGrid,
        response: Array,
        smoothness: Array,
        lumped: Array,
    ) -> None:
        along = np.diag([1.0, 1.0, 0.0]), np.diag([0.0, 0.0, 1.0])
        smooth = [sparse.csr_array(sparse.kron(smoothness, components)) for components in along]
        nodal = sparse.csr_array(sparse.kron(lumped, sparse.eye_array(3)))
        self.parts = [
            _Part(parity, (markers, nodes), response, (smooth[0], smooth[1]), nodal)
            for parity in PARITIES
        ]
        # For what a solution leaves over and for its size 1e-7 of it will do, in half the time.
        self._smoothness = smoothness.astype(np.float32)
        to_nodes = sparse.hstack([part.of_nodes for part in self.parts])
        self.from_nodes, self.onto_nodes = SparseRows(to_nodes.T), SparseRows(to_nodes)
        self._fold_of_markers = Fold.into(part.of_markers for part in self.parts)
        self.fold = Fold.into(part.of_nodes for part in self.parts)
        of_modes = Fold.one_after_another([len(part.values) for part in self.parts])
        analysis = [part.modes_of_data for part in self.parts]
        self._analysis = MirroredProduct(analysis, self._fold_of_markers, of_modes)
        vectors = [part.vectors.T.astype(np.float32) for part in self.parts]
        self._synthesis = MirroredProduct(vectors, of_modes, self.fold)
        pulls = [part.response for part in self.parts]
        self._pull = MirroredProduct(pulls, self._fold_of_markers, self.fold)
        responses = [part.response.T.astype(np.float32) for part in self.parts]
        self._response = MirroredProduct(responses, self.fold, self._fold_of_markers)
        squares = np.concatenate([part.nodal_squares for part in self.parts], axis=1)
        self._nodal_squares = np.ascontiguousarray(
            squares.reshape(-1, 3, squares.shape[1]).transpose(1, 0, 2), np.float32
        )
        self._of_quarter = _quarter(nodes)[1]
        self._normal_share = np.concatenate([part.normal_share for part in self.parts])
        self.values = np.concatenate([part.values for part in self.parts])
        self.scale = float(self.values.max())
        weights = WEIGHTS[:, None] * self.scale
        self._shrink = 1 / (self.values + weights)
        self._log_prior = 0.5 * np.log(weights * self._shrink).sum(axis=1)

    def solve(
        self, data: Array, known: NDArray[np.bool_], weight: float | None = None
    ) -> FirstPass:
        """First pass over data (m,), in units of the noise, of which only the `known` count.

        weight: relative; chosen by the evidence where it is not given.
        """
        data, count = np.where(known, data, 0.0), int(np.count_nonzero(known))
        total = float(data @ data)
        given = None if weight is None else int(np.argmin(np.abs(np.log(WEIGHTS / weight))))
        modes = self._analysis.of_vector(data)
        index = self._likeliest(data, modes, count) if given is None else given
        if count < len(data):
            missing = np.flatnonzero(~known)
            in_modes = self._in_modes(missing)
            data[missing] = filled = _left_out(in_modes, self._shrink[index], modes)
            modes += filled @ in_modes
            index = self._likeliest(data, modes, count) if given is None else given
        gain = self._shrink[index]
        misfit = max(float(data @ data - gain @ modes**2), 0.0)
        noise = max(misfit / count, MIN_NOISE_SQUARED)
        evidence = float(_log_evidence(misfit, noise, count) + self._log_prior[index])
        alone = max(total / count, MIN_NOISE_SQUARED)
        coefficient = self._synthesis.of_vector(gain * modes)
        variance = self._nodal_squares[2] @ (noise * self.values * gain**2).astype(np.float32)
        return FirstPass(
            coefficient,
            data,
            noise,
            float(WEIGHTS[index]),
            evidence - float(_log_evidence(total, alone, count)),
            np.sqrt(variance[self._of_quarter].astype(np.float64)),
        )

    def respond(self, coefficient: Array) -> Array:
        """G f: data (m,) that coefficients (n,) cause."""
        return self._response.of_vector(coefficient)

    def pull(self, data: Array) -> Array:
        """G' d: what data (m,) ask of the coefficients, (n,)."""
        return self._pull.of_vector(data)

    def noise_covariance(self, functionals: Array, weight: float) -> Array:
        """Covariance (j, j) of functionals (j, n) of the coefficients by noise of 1 alone."""
        folded = self.from_nodes.of_columns(functionals.T)
        of_modes = product_of_parts([part.vectors.T for part in self.parts], folded)
        half = of_modes * (np.sqrt(self.values) / (self.values + weight * self.scale))[:, None]
        return np.asarray(half.T @ half)

    def nodal_variance(self, tangential: float, normal: float) -> Array:
        """Posterior variance (nodes, 3) of consistent nodal forces for noise of 1.

        Were the whole surface in contact; tangential, normal: weights of the two smoothnesses.
        """
        found = np.empty((len(self._of_quarter), 3))
        for axis, weight in enumerate((tangential * TANGENTIAL_SHARE**2,) * 2 + (normal,)):
            variance = 1 / (self.values + weight)
            of_quarter = self._nodal_squares[axis] @ variance.astype(np.float32)
            found[:, axis] = of_quarter[self._of_quarter]
        return found

    def scale_of_first(self, first: FirstPass) -> TractionScale:
        """Expected size of what the first pass found, by one step of MacKay's rule.

        From the sizes that its weight stands for towards those for which the data are likeliest:
        the energy of either part over how many numbers of it the data determine.
        """
        normal = first.weight * self.scale
        determined = self.determined(normal / TANGENTIAL_SHARE**2, normal)
        sizes = np.sqrt(self.energy(first.coefficient) / np.maximum(determined, 1.0))
        return TractionScale(float(sizes[1]), float(sizes[0]))

    def energy(self, coefficient: Array) -> Array:
        """Roughness (2,) of the tangential and of the normal part of coefficients (n,)."""
        found = coefficient.reshape(-1, 3)
        by_axis = np.einsum("ij,ij->j", found, self.smoothed(found))
        return np.array([by_axis[0] + by_axis[1], by_axis[2]])

    def smoothed(self, coefficient: Array) -> Array:
        """Smoothness times coefficients (nodes, 3)."""
        return np.asarray(self._smoothness @ coefficient.astype(np.float32), np.float64)

    def determined(self, tangential: float, normal: float) -> Array:
        """How many numbers of the tangential and of the normal part data determine, (2,)."""
        along = tangential * TANGENTIAL_SHARE**2
        of_normal = self._normal_share * self.values / (self.values + normal)
        of_tangential = (1 - self._normal_share) * self.values / (self.values + along)
        return np.array([of_tangential.sum(), of_normal.sum()])

    def _likeliest(self, data: Array, modes: Array, count: int) -> int:
        """Number of the weight of greatest evidence, for data (m,) and their modes."""
        misfit = np.maximum(data @ data - self._shrink @ modes**2, 0.0)
        noise = np.maximum(misfit / count, MIN_NOISE_SQUARED)
        return int(np.argmax(_log_evidence(misfit, noise, count) + self._log_prior))

    def _in_modes(self, some: NDArray[np.intp]) -> NDArray[np.float32]:
        """Modes (q, modes) of a unit in each of some data (q,)."""
        parts = [
            share[some, None] * part.modes_of_data[place[some]]
            for part, place, share in zip(self.parts, *self._fold_of_markers, strict=True)
        ]
        return np.concatenate(parts, axis=1, dtype=np.float32)


def _left_out(in_modes: NDArray[np.float32], gain: Array, modes: Array) -> NDArray[np.float32]:
    """Missing data (q,) as the solution itself predicts them, which is to leave them out.

    in_modes (q, modes): of a unit in each.  gain, modes (modes,): of the solution without them.
    The fit then pulls nowhere at the missing data (leave-out formula of linear smoothers); the
    system for them, 1 - H with H the smoother, is solved by conjugate gradients.
    """
    single = gain.astype(np.float32)
    residual = direction = in_modes @ (gain * modes).astype(np.float32)
    power, filled = float(residual @ residual), np.zeros_like(residual)
    enough = FILL_TOLERANCE_NOISE**2 * len(residual)
    for _ in range(MAX_FILL_STEPS):
        if power <= enough:
            break
        image = direction - in_modes @ (single * (direction @ in_modes))
        step = power / float(direction @ image)
        filled += step * direction
        residual = residual - step * image
        last, power = power, float(residual @ residual)
        direction = residual + power / last * direction
    return filled


def _log_evidence(misfit: Any, noise: Any, count: int) -> Any:
    return -0.5 * (misfit / noise + count * np.log(noise))


def _quarter(grid: SurfaceGrid) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Numbers of the points of a quarter, and of the one of these that each point mirrors."""
    row, col = (np.arange(count) for count in (grid.rows, grid.cols))
    row, col = np.minimum(row, row[::-1]), np.minimum(col, col[::-1])
    mirrored = (row[:, None] * grid.cols + col).ravel()
    points, of_quarter = np.unique(mirrored, return_inverse=True)
    return points, of_quarter
