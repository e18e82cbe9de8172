"""Inverses of the normal equations on the nodes that are in contact.

For a few nodes they are factored themselves.  For many nodes the inverse is that for the whole
surface, which falls into four parts by parity and serves any mask, with the nodes beside the
contact held free of traction: only as many unknowns as these have are factored.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.linalg.blas import dtrsm

from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_processing.elastic.mirror_symmetry import MirroredProduct, product_of_parts
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.force.traction_spectrum import TractionSpectrum

Array = NDArray[np.float64]
Numbers = NDArray[np.intp]


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
    """Inverse of a positive definite matrix (n, n).  Raises InputError for another one."""

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

    It may take the matrix's place.  Raises InputError for one that is not positive definite.
    """
    if not len(matrix):
        return matrix
    lower, info = lapack.dpotrf(matrix, lower=1, clean=0, overwrite_a=1)
    if info:
        raise InputError("matrix: found one that is not definite")
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
        raise InputError("matrix: found one that is not definite")
    lower = np.tril(inverse)
    return np.ascontiguousarray(lower + np.tril(inverse, -1).T)
