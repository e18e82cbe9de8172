"""Splitting of fields over a rectangle into parts that are even or odd in x and in y.

A block that is its own mirror image in x and in y answers each part by itself, so that a quarter
of it, solved four times, stands for the whole.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cmp_tactile_processing.cache.kernels import kernel, plain
from cmp_tactile_processing.measured import SurfaceGrid

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Parity:
    """Vector fields whose z component is even (+1) or odd (-1) in x and in y.

    The component along the mirrored axis turns round in a mirror: it has the opposite sign.
    """

    x: int
    y: int

    def sign_x(self, component: int) -> int:
        """+1 where this component is even in x, -1 where it is odd."""
        return -self.x if component == 0 else self.x

    def sign_y(self, component: int) -> int:
        """+1 where this component is even in y, -1 where it is odd."""
        return -self.y if component == 1 else self.y

    def extension(self, rows: int, cols: int) -> sparse.csr_array:
        """Matrix from the values on a quarter of a grid to the values on the whole of it.

        Grid point (i, j), component c: entry 3 (i cols + j) + c; the quarter's first point is
        (rows // 2, cols // 2).  It is made once, so it must not be written to.
        """
        return _extension(self, rows, cols)

    def orthonormal(self, rows: int, cols: int) -> sparse.csc_array:
        """Orthonormal basis of these fields on a grid, (3 rows cols, k)."""
        basis = self.extension(rows, cols).tocsc()
        norm = np.sqrt(basis.multiply(basis).sum(axis=0))
        used = np.flatnonzero(norm)
        return sparse.csc_array(basis[:, used] @ sparse.diags_array(1 / norm[used]))

    def lattice_extension(self, lattice: tuple[int, int, int]) -> sparse.csr_array:
        """The same for the nodes (ix * ny + iy) * nz + iz of a block's lattice (nx, ny, nz)."""
        nx, ny, nz = lattice
        lines = [(_extend(nx, self.sign_x(c)), _extend(ny, self.sign_y(c))) for c in range(3)]
        return _by_component(lines, nz)

    def free(self, lattice: tuple[int, int, int]) -> NDArray[np.bool_]:
        """Unknowns (nx, ny, nz, 3) of a quarter block held neither at its base nor by parity."""
        free = np.ones((*lattice, 3), dtype=bool)
        free[:, :, 0] = False
        for component in range(3):
            free[0, :, :, component] &= self.sign_x(component) > 0
            free[:, 0, :, component] &= self.sign_y(component) > 0
        return free


PARITIES = tuple(Parity(x, y) for x in (1, -1) for y in (1, -1))


def mirrored_response(
    responses: Iterable[NDArray[Any]], source: SurfaceGrid, target: SurfaceGrid, values: Array
) -> Array:
    """What values (3 source,) cause on the whole target grid, (3 target,).

    responses: one per parity, of the target's quarter to unit parts on the source's quarter, in
    single or double precision.
    """
    folded = _folds(source.rows, source.cols).of_vector(values)
    return _unfolds(target.rows, target.cols).of_vector(product_of_parts(responses, folded))


def product_of_parts(parts: Iterable[NDArray[Any]], values: Array) -> Array:
    """Each part's matrix times its share of the values (n,) or (n, k), one after the other."""
    products, place = [], 0
    for part in parts:
        share = values[place : place + part.shape[1]]
        products.append(part @ share.astype(part.dtype, copy=False))
        place += part.shape[1]
    return np.concatenate(products, dtype=np.float64)


class Fold(NamedTuple):
    """How the unknowns (n,) of a grid fall into parts, one for each parity.

    Unknown i belongs to unknown place[p][i] of part p alone, with the factor share[p][i].
    """

    place: tuple[NDArray[np.intp], ...]
    share: tuple[Array, ...]

    @classmethod
    def into(cls, bases: Iterable[sparse.sparray]) -> Fold:
        """From the parts' bases, (n, part) each, such as those of `Parity.orthonormal`."""
        places, shares = [], []
        for basis in bases:
            entries = sparse.coo_array(basis)
            place, share = np.zeros(basis.shape[0], np.intp), np.zeros(basis.shape[0])
            place[entries.row], share[entries.row] = entries.col, entries.data
            places.append(place)
            shares.append(share)
        return cls(tuple(places), tuple(shares))

    @classmethod
    def one_after_another(cls, sizes: Sequence[int]) -> Fold:
        """That of unknowns which are those of parts of such sizes, one part after the other."""
        every, ends = sparse.eye_array(sum(sizes), format="csc"), np.cumsum(sizes)
        return cls.into(every[:, end - size : end] for size, end in zip(sizes, ends, strict=True))


class MirroredProduct:
    """Products of a matrix in parts, one for each parity, with vectors that may be 0 in many rows.

    parts: each (source part, target part), what units of the source cause; in single or double
    precision.  source, target: how the unknowns of the two grids fall into them.
    """

    def __init__(self, parts: Iterable[NDArray[Any]], source: Fold, target: Fold) -> None:
        self.parts = tuple(np.ascontiguousarray(part) for part in parts)
        self._folds = *source, *target

    def of_vector(self, values: Array) -> Array:
        """The product with a vector (source,), (target,)."""
        _require(values.shape, self._folds[0][0].shape)
        return _mirrored_product(self.parts, *self._folds, plain(values, np.float64))


@kernel
def _mirrored_product(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    parts: tuple[NDArray[Any], ...],
    source_place: tuple[NDArray[np.intp], ...],
    source_share: tuple[Array, ...],
    target_place: tuple[NDArray[np.intp], ...],
    target_share: tuple[Array, ...],
    values: Array,
) -> Array:
    """As MirroredProduct.of_vector; rows of a part for which the values are 0 are not read."""
    product: Array = np.zeros(len(target_place[0]))
    for p in range(len(parts)):
        part, place, share = parts[p], source_place[p], source_share[p]
        folded, found = np.zeros(len(part), part.dtype), np.zeros(part.shape[1], part.dtype)
        for i in range(len(values)):
            folded[place[i]] += share[i] * values[i]
        for k in range(len(part)):
            if folded[k] != 0:
                row, factor = part[k], folded[k]
                for j in range(len(row)):
                    found[j] += factor * row[j]
        place, share = target_place[p], target_share[p]
        for i in range(len(product)):
            product[i] += share[i] * found[place[i]]
    return product


class SparseRows:
    """Products of a sparse matrix, of any form that SciPy knows, with what a frame brings.

    SciPy takes 20 to 40 us to find out what is to be multiplied, more than the product itself.
    """

    def __init__(self, matrix: sparse.sparray) -> None:
        rows = sparse.csr_array(matrix)
        self.shape: tuple[int, int] = rows.shape
        starts, columns = rows.indptr.astype(np.intp), rows.indices.astype(np.intp)
        self._rows = starts, columns, rows.data.astype(np.float64)

    def of_vector(self, vector: Array) -> Array:
        """The product with a vector (columns,)."""
        _require(vector.shape, self.shape[1:])
        return _product(*self._rows, plain(vector, np.float64).reshape(-1, 1)).reshape(-1)

    def of_columns(self, matrix: Array) -> Array:
        """The product with a matrix (columns, k)."""
        _require(matrix.shape[:1], self.shape[1:])
        return _product(*self._rows, plain(matrix, np.float64))


def _require(found: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if found != expected:
        msg = f"found shape {found}, expected {expected}"
        raise ValueError(msg)


@kernel
def _product(
    starts: NDArray[np.intp], columns: NDArray[np.intp], values: Array, matrix: Array
) -> Array:
    """Product of a sparse matrix, of which row i has values[k] at columns[k], with a matrix.

    k goes from starts[i] to starts[i + 1].
    """
    product: Array = np.zeros((len(starts) - 1, matrix.shape[1]))
    for row in range(len(product)):
        for k in range(starts[row], starts[row + 1]):
            for j in range(matrix.shape[1]):
                product[row, j] += values[k] * matrix[columns[k], j]
    return product


# Every frame asks for the same two grids.
@lru_cache(maxsize=64)
def _folds(rows: int, cols: int) -> SparseRows:
    """From the values on a whole grid to those on its quarter, one parity after the other."""
    return SparseRows(sparse.vstack([parity.extension(rows, cols).T for parity in PARITIES]))


@lru_cache(maxsize=64)
def _unfolds(rows: int, cols: int) -> SparseRows:
    """From the values on a quarter, one parity after the other, to those on the whole grid."""
    return SparseRows(sparse.hstack([parity.extension(rows, cols) for parity in PARITIES]))


# Calibration asks for the same two grids some thousand times.
@lru_cache(maxsize=64)
def _extension(parity: Parity, rows: int, cols: int) -> sparse.csr_array:
    lines = [(_extend(rows, parity.sign_y(c)), _extend(cols, parity.sign_x(c))) for c in range(3)]
    whole = _by_component(lines)
    whole.data.flags.writeable = False
    return whole


def _by_component(
    lines: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]], levels: int = 1
) -> sparse.csr_array:
    """Tensor products of the factors along two lines, one pair of them for each component."""
    total = None
    for component, (first, second) in enumerate(lines):
        of_component = np.diag(np.tile(np.arange(3) == component, levels)).astype(np.float64)
        part = sparse.kron(sparse.kron(first, second), of_component)
        total = part if total is None else total + part
    return sparse.csr_array(total)


def _extend(count: int, sign: int) -> NDArray[np.float64]:
    """Values at the upper half of a symmetric line -> values on all of it, (count, half)."""
    start = count // 2
    matrix = np.zeros((count, count - start))
    for index in range(start, count):
        mirrored = count - 1 - index
        matrix[mirrored, index - start] = sign
        matrix[index, index - start] = 1 if index != mirrored or sign > 0 else 0
    return matrix
