"""Products of small sparse matrices with what a frame brings, some times quicker than SciPy's own.

SciPy takes 20 to 40 us to find out what is to be multiplied, more than the product itself takes.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse

__all__ = ["SparseRows"]

Array = NDArray[np.float64]


class SparseRows:
    """A sparse matrix by rows; any form that SciPy knows."""

    def __init__(self, matrix: sparse.sparray) -> None:
        rows = sparse.csr_array(matrix)
        self.shape: tuple[int, int] = rows.shape
        self.starts = rows.indptr.astype(np.intp)
        self.columns = rows.indices.astype(np.intp)
        self.values = rows.data.astype(np.float64)
        # Compiled, or read from numba's cache, before the first frame.
        self.of_vector(np.zeros(self.shape[1]))
        self.of_columns(np.zeros((self.shape[1], 1)))

    def of_vector(self, vector: Array) -> Array:
        """The product with a vector (columns,)."""
        _require(vector.shape, self.shape[1:])
        return _of_vector(self.starts, self.columns, self.values, _plain(vector))

    def of_columns(self, matrix: Array) -> Array:
        """The product with a matrix (columns, k)."""
        _require(matrix.shape[:1], self.shape[1:])
        return _of_columns(self.starts, self.columns, self.values, _plain(matrix))


def _plain(values: Array) -> Array:
    """As what is compiled takes it: others would be compiled for anew, in a frame."""
    return np.require(values, np.float64, ["C", "W"])


def _require(found: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if found != expected:
        msg = f"found shape {found}, expected {expected}"
        raise ValueError(msg)


@njit(cache=True, nogil=True, error_model="numpy")
def _of_vector(
    starts: NDArray[np.intp], columns: NDArray[np.intp], values: Array, vector: Array
) -> Array:
    product: Array = np.empty(len(starts) - 1)
    for row in range(len(product)):
        total = 0.0
        for k in range(starts[row], starts[row + 1]):
            total += values[k] * vector[columns[k]]
        product[row] = total
    return product


@njit(cache=True, nogil=True, error_model="numpy")
def _of_columns(
    starts: NDArray[np.intp], columns: NDArray[np.intp], values: Array, matrix: Array
) -> Array:
    product: Array = np.zeros((len(starts) - 1, matrix.shape[1]))
    for row in range(len(product)):
        for k in range(starts[row], starts[row + 1]):
            source = matrix[columns[k]]
            for j in range(matrix.shape[1]):
                product[row, j] += values[k] * source[j]
    return product
