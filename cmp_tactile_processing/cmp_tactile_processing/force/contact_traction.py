"""Second pass: the traction on the nodes that are in contact, all others being free of it.

The posterior of a linear model with Gaussian noise and a smooth prior.  How large normal and
tangential traction are expected to be follows from the first pass, and the noise from what the
solution leaves over.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.linalg.blas import dtrsm

from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_processing.elastic.mirror_symmetry import MirroredProduct, product_of_parts
from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.force.traction_spectrum import (
    MIN_NOISE_SQUARED,
    TractionScale,
    TractionSpectrum,
)

Array = NDArray[np.float64]
Numbers = NDArray[np.intp]
Mask = NDArray[np.bool_]
Value = TypeVar("Value")
# The tangential traction is never expected to be less than this share of the normal one.
MIN_TANGENTIAL, MIN_NORMAL_N = 0.02, 1e-9
# Weights of the smoothness are taken from this grid, in decades: a fifth of a size, which changes
# the forces by a fraction of their deviations, so that a factor serves many frames.
WEIGHT_STEP = 0.4
# Standard deviation of a weight's logarithm: what the grid and one step of MacKay's rule leave.
WEIGHT_DOUBT = 0.5
# MacKay's rule goes some half of the way to the likeliest size where the data say little, and all
# of it where they say much.
OVERSHOOT = 1.4
# Steps on the grid below which weights stay as they are: that is about their doubt.
NEAR_STEPS = 1.0
# How many numbers the data determine is worked out in full on so many nodes, or where more than
# this share of the data is missing, and else as if the whole surface were in contact and seen.
MOST_TRACED, MANY_MISSING = 100, 0.05
# Nodes come into a mask and leave it in threes, as neighbours of one that stands out.
TOGETHER = 3.0
# Masks of more than this share of the nodes are solved by what is beside them, if not more data
# than this share of the unknowns are missing.
WIDE, FEW_MISSING = 0.5, 0.15
# Factors that are kept, for masks that come and go, and bytes of inverses, for a press that grows
# and falls: twenty of 20 x 20 nodes.
KEPT_FACTORS, KEPT_BYTES = 8, 90e6


class Factor(ABC):
    """Inverse (n, n) of the normal equations; what was asked last of its diagonal is kept."""

    def __init__(self) -> None:
        self._diagonal: tuple[bytes | None, Array] = None, np.zeros(0)

    @abstractmethod
    def solve(self, right: Array) -> Array:
        """The inverse times right (n, j)."""

    @abstractmethod
    def joint(self, right: Array, unknowns: Numbers) -> tuple[Array, Array]:
        """Product (j, j) of right (n, j) with its solution, and some rows (k, j) of that."""

    def variance(self, unknowns: Numbers) -> Array:
        """Diagonal of the inverse at some unknowns (k,)."""
        asked = unknowns.tobytes()
        if asked != self._diagonal[0]:
            self._diagonal = asked, self._variance(unknowns)
        return self._diagonal[1]

    @abstractmethod
    def _variance(self, unknowns: Numbers) -> Array: ...


class DirectFactor(Factor):
    """Inverse of a positive definite matrix (n, n).  Raises GeometryError for another one."""

    def __init__(self, matrix: Array) -> None:
        super().__init__()
        self._lower = lower_factor(matrix)
        self._trace: Array | None = None

    def solve(self, right: Array) -> Array:
        """As Factor."""
        return backward(self._lower, forward(self._lower, right))

    def joint(self, right: Array, unknowns: Numbers) -> tuple[Array, Array]:
        """As Factor."""
        half = forward(self._lower, right)
        first, lower = self._from(unknowns)
        return half.T @ half, backward(lower, half[first:])[unknowns - first]

    def trace(self, smooth: Array) -> Array:
        """Traces (3,) of the inverse of each component times a symmetric matrix (n / 3, n / 3).

        The matrix is the same in every call.
        """
        if self._trace is None:
            inverse = lapack.dpotri(self._lower, lower=1)[0]
            parts = [np.tril(inverse[axis::3, axis::3]) for axis in range(3)]
            doubled = 2.0 * smooth
            np.fill_diagonal(doubled, np.diag(smooth))
            self._trace = np.array([np.vdot(part, doubled) for part in parts])
        return self._trace

    def _variance(self, unknowns: Numbers) -> Array:
        first, lower = self._from(unknowns)
        half = forward(lower, units_of(unknowns - first, len(lower)))
        return np.asarray(np.einsum("ij,ij->j", half, half))

    def _from(self, unknowns: Numbers) -> tuple[int, Array]:
        """The first of some unknowns, and the factor from it on: the rest has no part in them."""
        first = int(unknowns.min(initial=len(self._lower)))
        return first, self._lower[first:, first:]


class UpdatedFactor(Factor):
    """The inverse for fewer data than a factor's, which may serve many frames (Woodbury).

    gone (q, n): response at the data that are not known, a few.
    """

    def __init__(self, factor: DirectFactor, gone: Array) -> None:
        super().__init__()
        self._factor, self._gone = factor, gone
        self._spread = factor.solve(np.asfortranarray(gone.T))
        self._rest = lower_factor(np.eye(len(gone)) - gone @ self._spread)

    def solve(self, right: Array) -> Array:
        """As Factor."""
        found = self._factor.solve(right)
        return found + self._spread @ self._multipliers(self._gone @ found)

    def joint(self, right: Array, unknowns: Numbers) -> tuple[Array, Array]:
        """As Factor."""
        product, rows = self._factor.joint(right, unknowns)
        lost = self._spread.T @ right
        multipliers = self._multipliers(lost)
        return product + lost.T @ multipliers, rows + self._spread[unknowns] @ multipliers

    def _variance(self, unknowns: Numbers) -> Array:
        lost = forward(self._rest, self._spread[unknowns].T)
        return np.asarray(self._factor.variance(unknowns) + np.einsum("ij,ij->j", lost, lost))

    def _multipliers(self, lost: Array) -> Array:
        return backward(self._rest, forward(self._rest, lost))


class WholeSurface:
    """Inverse of G'G + weighted smoothness on all nodes, for data that are all known.

    tangential, normal: weights of the smoothness of the two.
    """

    def __init__(self, spectrum: TractionSpectrum, tangential: float, normal: float) -> None:
        self._fold, self._unfold = spectrum.from_nodes, spectrum.onto_nodes
        inverses = [
            _inverse(part.gram + tangential * part.tangential + normal * part.normal)
            for part in spectrum.parts
        ]
        self._product = MirroredProduct(inverses, spectrum.fold, spectrum.fold)
        self._folded = list(zip(self._product.parts, *spectrum.fold, strict=True))
        # Error bars are right to 1e-4 with it, in half the time.
        self._single = [part.astype(np.float32) for part in inverses]

    def apply(self, right: Array) -> Array:
        """The inverse times right (3 nodes, j), of which many rows may be 0."""
        if right.shape[1] == 1:
            return self._product.of_vector(right[:, 0])[:, None]
        return self._unfolded(self._product.parts, right)

    def apply_roughly(self, right: Array) -> Array:
        """The same in single precision: for error bars."""
        return self._unfolded(self._single, right)

    def block(self, rows: Numbers, columns: Numbers, *, lower: bool = False) -> Array:
        """The inverse between some unknowns, (rows, columns); lower: not above the diagonal."""
        total = np.zeros((len(rows), len(columns)))
        for part, at, share in self._folded:
            add_block(part, at[rows], share[rows], at[columns], share[columns], lower, total)
        return total

    def diagonal(self, unknowns: Numbers) -> Array:
        """The inverse's diagonal at some unknowns (k,)."""
        total = np.zeros(len(unknowns))
        for part, at, share in self._folded:
            total += np.diag(part)[at[unknowns]] * share[unknowns] ** 2
        return total

    def _unfolded(self, parts: Sequence[NDArray[Any]], right: Array) -> Array:
        return self._unfold.of_columns(product_of_parts(parts, self._fold.of_columns(right)))


class ComplementFactor(Factor):
    """The inverse on some unknowns (k,), by that of the whole surface.

    gone (q, 3 nodes): response at the data that are not known.
    With E that takes out the unknowns beside the contact and the data that are gone, the inverse is
    W - W E' S^-1 E W, where S = E W E' - D; D is 0 for the unknowns and 1 for the data (Woodbury).
    """

    def __init__(self, whole: WholeSurface, unknowns: Numbers, gone: Array) -> None:
        super().__init__()
        self._whole, self._unknowns, self._gone = whole, unknowns, gone
        self._size = gone.shape[1]
        beside = np.ones(self._size, dtype=bool)
        beside[unknowns] = False
        self._beside = np.flatnonzero(beside)
        self._first = lower_factor(whole.block(self._beside, self._beside, lower=True))
        self._spread = whole.apply(gone.T) if len(gone) else gone.T
        self._across = forward(self._first, self._spread[self._beside])
        second = np.eye(len(gone)) + self._across.T @ self._across - gone @ self._spread
        self._second = lower_factor(second)
        self._between: tuple[bytes | None, Array] = None, np.zeros(0)

    def solve(self, right: Array) -> Array:
        """As Factor."""
        free = self._whole.apply(self._on_all(right))
        held, data = self._multipliers(*self._halves(free[self._beside], self._gone @ free))
        taken = self._gone.T @ data
        taken[self._beside] += held
        return np.asarray((free - self._whole.apply(taken))[self._unknowns])

    def joint(self, right: Array, unknowns: Numbers) -> tuple[Array, Array]:
        """As Factor."""
        free = self._whole.apply_roughly(self._on_all(right))
        first, second = self._halves(free[self._beside], self._gone @ free)
        product = right.T @ free[self._unknowns] - first.T @ first + second.T @ second
        held, data = self._multipliers(first, second)
        chosen = self._unknowns[unknowns]
        rows = free[chosen] - self._to_beside(chosen).T @ held - self._spread[chosen] @ data
        return product, rows

    def _variance(self, unknowns: Numbers) -> Array:
        chosen = self._unknowns[unknowns]
        first, second = self._halves(self._to_beside(chosen), self._spread[chosen].T)
        lost = np.einsum("ij,ij->j", first, first) - np.einsum("ij,ij->j", second, second)
        return np.asarray(self._whole.diagonal(chosen) - lost)

    def _on_all(self, right: Array) -> Array:
        """right (k, j) as (3 nodes, j), 0 beside the contact."""
        whole = np.zeros((self._size, right.shape[1]))
        whole[self._unknowns] = right
        return whole

    def _to_beside(self, chosen: Numbers) -> Array:
        """The whole surface's inverse from some unknowns to those beside, the last one kept."""
        asked = chosen.tobytes()
        if asked != self._between[0]:
            self._between = asked, self._whole.block(self._beside, chosen)
        return self._between[1]

    def _halves(self, held: Array, data: Array) -> tuple[Array, Array]:
        first = forward(self._first, held)
        return first, forward(self._second, data - self._across.T @ first)

    def _multipliers(self, first: Array, second: Array) -> tuple[Array, Array]:
        data = -backward(self._second, second)
        return backward(self._first, first - self._across @ data), data


def units_of(unknowns: Numbers, size: int) -> Array:
    """Columns (size, k) of the unit matrix."""
    units = np.zeros((size, len(unknowns)), order="F")
    units[unknowns, np.arange(len(unknowns))] = 1.0
    return units


def lower_factor(matrix: Array) -> Array:
    """L (n, n) with L L' = matrix, of which what is above the diagonal does not count in either.

    It may take the matrix's place.  Raises GeometryError for one that is not positive definite.
    """
    if not len(matrix):
        return matrix
    lower, info = lapack.dpotrf(matrix, lower=1, clean=0, overwrite_a=1)
    if info:
        raise GeometryError("matrix: found one that is not definite")
    return np.asarray(lower)


@kernel
def add_block(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    part: Array, rows: Numbers, of_rows: Array, columns: Numbers, of_columns: Array,
    lower: bool, total: Array,
) -> None:  # fmt: skip
    """Add entries of a part, each times the shares of its row and of its column, to a total.

    rows, of_rows (k,); columns, of_columns (j,); total (k, j); lower: not above the diagonal.
    """
    for i in range(len(rows)):
        row, share = part[rows[i]], of_rows[i]
        for j in range(i + 1 if lower else len(columns)):
            total[i, j] += share * of_columns[j] * row[columns[j]]


@kernel
def weighted_equations(
    normal: Array, smooth: Array, nodes: Numbers, tangential: float, vertical: float
) -> Array:
    """Normal equations (3 k, 3 k) of some nodes (k,), of which the lower triangle is filled.

    normal (3 n, 3 n): those of the data, of all nodes; smooth (n, n): smoothness of a component,
    which counts with a weight for each of the two tangential ones, and for the vertical one.
    """
    count = len(nodes)
    found = np.zeros((3 * count, 3 * count))
    for j in range(count):
        for b in range(3):
            row, column = normal[3 * nodes[j] + b], found[3 * j + b]
            weight = vertical if b == 2 else tangential
            for i in range(j, count):
                for a in range(3):
                    column[3 * i + a] = row[3 * nodes[i] + a]
                column[3 * i + b] += weight * smooth[nodes[j], nodes[i]]
    lower: Array = found.T  # in the order of columns, as LAPACK has it
    return lower


def forward(lower: Array, right: Array) -> Array:
    """L^-1 right (n, j)."""
    return _triangular(lower, right, 0)


def backward(lower: Array, right: Array) -> Array:
    """L'^-1 right (n, j)."""
    return _triangular(lower, right, 1)


def _triangular(lower: Array, right: Array, transposed: int) -> Array:
    if not right.size:
        return right
    found: Any = dtrsm(1.0, lower, right, lower=1, trans_a=transposed)
    return np.asarray(found)


def _inverse(matrix: Array) -> Array:
    inverse, info = lapack.dpotri(lower_factor(matrix), lower=1)
    if info:
        raise GeometryError("matrix: found one that is not definite")
    lower = np.tril(inverse)
    return np.ascontiguousarray(lower + np.tril(inverse, -1).T)


class Weights(NamedTuple):
    """Weights of the smoothness of tangential and normal coefficients, squared noise being 1."""

    tangential: float
    normal: float


class SeenData(NamedTuple):
    """Data (m,) in units of the noise, 0 where they are not known; known (m,).

    pull (3 nodes,): G' d.  missing: bytes of the numbers of those that are not known.
    """

    data: Array
    known: Mask
    pull: Array
    missing: bytes

    @property
    def missing_share(self) -> float:
        """Of all data, those that are not known."""
        return len(np.frombuffer(self.missing, np.intp)) / len(self.data)


@dataclass(frozen=True)
class TractionPosterior:
    """Coefficients on the nodes of the mask, and how well they are known.

    nodes (k,): numbers.  coefficient (3 k,) N.  noise_squared: of the data.  weights: of their
    prior.  factor: inverse (3 k, 3 k) of the normal equations, the covariance for noise of 1.
    drift (3 k, 2): what a change of the two weights' logarithms adds to the normal equations.
    edge: how many of the nodes, the last ones, a little more noise would have left out of the mask,
    so that whether they bear anything is in doubt.
    """

    nodes: NDArray[np.intp]
    coefficient: Array
    noise_squared: float
    weights: Weights
    factor: Factor
    drift: Array
    edge: int = 0

    def covariances(self, functionals: Array) -> tuple[Array, Array]:
        """Covariance (j, j) of linear functionals (j, 3 k) of the coefficients, for these weights.

        With it what weights and edge leave open on top of that, (j, j).
        """
        count = len(functionals)
        at, pull = self._edge_pull
        joint, rows = self.factor.joint(np.hstack([functionals.T, self.drift]), at)
        of_weights = WEIGHT_DOUBT * joint[:count, count:]
        # How functionals change where a node of the edge is free of traction.
        lost = (rows[:, :count] * pull[:, None]).reshape(-1, 3, count).sum(axis=1)
        doubt = of_weights @ of_weights.T + TOGETHER * lost.T @ lost
        return self.noise_squared * joint[:count, :count], doubt

    @cached_property
    def _edge_pull(self) -> tuple[NDArray[np.intp], Array]:
        """Unknowns of the edge, and what has to pull at each for it to bear nothing."""
        at = np.arange(len(self.coefficient) - 3 * self.edge, len(self.coefficient))
        return at, self.coefficient[at] / self.factor.variance(at)


class ContactTraction:
    """Solves for the coefficients on some of the nodes.

    response G (3 markers, 3 nodes): displacement in units of its noise, per N.
    smoothness (nodes, nodes): precision of one component.

    Factors are kept by what they follow from, the mask, the weights and which data are missing, so
    that a solution owes nothing to those before it.
    """

    def __init__(self, spectrum: TractionSpectrum, response: Array, smoothness: Array) -> None:
        self._spectrum, self._response, self._smoothness = spectrum, response, smoothness
        self._normal = np.asarray(response.T @ response)
        self._felt = response.any(axis=1)
        size = 1.5 * sum(part.gram.nbytes for part in spectrum.parts)
        self._factors: _Kept[Factor] = _Kept(KEPT_FACTORS)
        self._direct: _Kept[DirectFactor] = _Kept(KEPT_FACTORS)
        self._inverses: _Kept[WholeSurface] = _Kept(max(2, int(KEPT_BYTES / size)))
        self._variances: _Kept[Array] = _Kept(KEPT_FACTORS)
        self._smooth: _Kept[Array] = _Kept(KEPT_FACTORS)
        # Compiled here, before the first frame.
        one = np.zeros(1, np.intp)
        weighted_equations(self._normal, self._smoothness, one, 1.0, 1.0)
        add_block(self._normal, one, np.ones(1), one, np.ones(1), False, np.zeros((1, 1)))

    def is_wide(self, nodes: NDArray[np.intp]) -> bool:
        """Whether nodes (k,) are most of the surface, so that less is beside them."""
        return len(nodes) > WIDE * len(self._smoothness)

    def weights(self, scale: TractionScale, noise_squared: float) -> Weights:
        """Weights for coefficients of an expected size, the nearest on the grid."""
        steps = np.round(self._steps(scale, noise_squared))
        return Weights(*(self._spectrum.scale * 10.0 ** (WEIGHT_STEP * steps)).tolist())

    def _steps(self, scale: TractionScale, noise_squared: float) -> Array:
        """Where on the grid the two weights are for coefficients of an expected size, (2,)."""
        normal = max(scale.normal, MIN_NORMAL_N)
        sizes = np.array([max(scale.tangential, MIN_TANGENTIAL * normal), normal])
        return np.asarray(np.log10(noise_squared / sizes**2 / self._spectrum.scale) / WEIGHT_STEP)

    def seen(self, data: Array, known: Mask) -> SeenData:
        """What of data (m,), in units of the noise, counts: the `known`."""
        data = np.where(known, data, 0.0)
        missing = np.flatnonzero(~known & self._felt)
        return SeenData(data, known, self._spectrum.pull(data), missing.tobytes())

    def solve(self, seen: SeenData, nodes: NDArray[np.intp], weights: Weights) -> TractionPosterior:
        """Posterior given what is seen.

        nodes (k,): where there may be traction.  Raises GeometryError for no nodes.
        """
        if not len(nodes):
            msg = "nodes: found none, expected at least 1"
            raise GeometryError(msg)
        key = weights, nodes.tobytes(), seen.missing
        factor = self._factors.get(key, lambda: self._new_factor(nodes, weights, seen))
        return self._posterior(seen, nodes, weights, factor)

    def likelier(self, posterior: TractionPosterior, seen: SeenData) -> Weights:
        """Weights for the size that the coefficients show; the posterior's where they are near."""
        scale, noise = self._scale(posterior, seen), posterior.noise_squared
        own = np.log10(np.array(posterior.weights) / self._spectrum.scale) / WEIGHT_STEP
        if np.abs(self._steps(scale, noise) - own).max() <= NEAR_STEPS:
            return posterior.weights
        return self.weights(scale, noise)

    def _scale(self, posterior: TractionPosterior, seen: SeenData) -> TractionScale:
        """From the sizes that the weights stand for towards likelier ones, by MacKay's rule."""
        nodes, (tangential, normal) = posterior.nodes, posterior.weights
        # The drift is what the weighted smoothness makes of the coefficients.
        energy = posterior.coefficient @ posterior.drift / (tangential, normal)
        if _is_traced(nodes, seen) and isinstance(posterior.factor, DirectFactor):
            trace = posterior.factor.trace(self._smooth_on(nodes))
            left = tangential * trace[:2].sum(), normal * trace[2]
            determined = np.array([2.0, 1.0]) * len(nodes) - left
        else:
            determined = self._spectrum.determined(*posterior.weights)
            determined = determined * len(nodes) / len(self._smoothness)
        sizes = np.sqrt(energy / np.maximum(determined, 1.0))
        before = np.sqrt(posterior.noise_squared / np.array(posterior.weights))
        sizes = before * (sizes / before) ** OVERSHOOT
        return TractionScale(float(sizes[1]), float(sizes[0]))

    def again(self, posterior: TractionPosterior, seen: SeenData) -> TractionPosterior:
        """The posterior for other data of the same markers, on the same nodes, with the weights."""
        found = self._posterior(seen, posterior.nodes, posterior.weights, posterior.factor)
        return replace(found, edge=posterior.edge)

    def nodal_variance(self, weights: Weights) -> Array:
        """As TractionSpectrum.nodal_variance."""
        return self._variances.get(weights, lambda: self._spectrum.nodal_variance(*weights))

    def _posterior(
        self,
        seen: SeenData,
        nodes: NDArray[np.intp],
        weights: Weights,
        factor: Factor,
    ) -> TractionPosterior:
        pull = seen.pull[unknowns_of(nodes)]
        coefficient = factor.solve(pull[:, None])[:, 0]
        # That of the greatest evidence for these weights.
        left = float(seen.data @ seen.data - coefficient @ pull)
        noise = max(left / np.count_nonzero(seen.known), MIN_NOISE_SQUARED)
        smoothed = self._smoothed(nodes, coefficient.reshape(-1, 3))
        drift = np.zeros((len(pull), 2))
        drift[0::3, 0], drift[1::3, 0] = weights.tangential * smoothed[:, :2].T
        drift[2::3, 1] = weights.normal * smoothed[:, 2]
        return TractionPosterior(nodes, coefficient, noise, weights, factor, drift)

    def _new_factor(self, nodes: NDArray[np.intp], weights: Weights, seen: SeenData) -> Factor:
        unknowns = unknowns_of(nodes)
        gone = self._response[np.frombuffer(seen.missing, np.intp)]
        if self.is_wide(nodes) and len(gone) < FEW_MISSING * len(unknowns):
            whole = self._inverses.get(weights, lambda: WholeSurface(self._spectrum, *weights))
            return ComplementFactor(whole, unknowns, gone)
        of_contact = gone.take(unknowns, axis=1)
        if len(gone) and _is_traced(nodes, seen):
            return self._direct_factor(nodes, weights, of_contact)
        complete = self._direct.get(
            (weights, nodes.tobytes()),
            lambda: self._direct_factor(nodes, weights, of_contact[:0]),
        )
        return UpdatedFactor(complete, of_contact) if len(gone) else complete

    def _direct_factor(
        self, nodes: NDArray[np.intp], weights: Weights, gone: Array
    ) -> DirectFactor:
        """gone (q, 3 k): response at data that are not known."""
        matrix = weighted_equations(self._normal, self._smoothness, nodes, *weights)
        if len(gone):
            matrix -= gone.T @ gone
        return DirectFactor(matrix)

    def _smooth_on(self, nodes: NDArray[np.intp]) -> Array:
        """Smoothness (k, k) of one component on some nodes."""
        return self._smooth.get(
            nodes.tobytes(), lambda: self._smoothness.take(nodes, axis=0).take(nodes, axis=1)
        )

    def _smoothed(self, nodes: NDArray[np.intp], values: Array) -> Array:
        """Smoothness times values (k, 3) on some nodes."""
        if not self.is_wide(nodes):
            return np.asarray(self._smooth_on(nodes) @ values)
        whole = np.zeros((len(self._smoothness), 3))
        whole[nodes] = values
        return np.asarray(self._spectrum.smoothed(whole)[nodes])


def _is_traced(nodes: NDArray[np.intp], seen: SeenData) -> bool:
    """Whether a trace of the inverse itself is needed."""
    return len(nodes) <= MOST_TRACED or seen.missing_share > MANY_MISSING


class _Kept(Generic[Value]):
    """The latest values, by what they follow from."""

    def __init__(self, most: int) -> None:
        self._most, self._values = most, OrderedDict[Hashable, Value]()

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The value of a key, made where it is not kept."""
        if key not in self._values:
            self._values[key] = make()
        self._values.move_to_end(key)
        if len(self._values) > self._most:
            self._values.popitem(last=False)
        return self._values[key]


def unknowns_of(nodes: NDArray[np.intp]) -> NDArray[np.intp]:
    """Numbers (3 k,) of the coefficients of nodes (k,)."""
    return np.asarray((3 * nodes[:, None] + np.arange(3)).ravel())
