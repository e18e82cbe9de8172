"""Cholesky factors of dense matrices, and what is solved with them, within compiled code.

LAPACK and BLAS are SciPy's, called by symbols that numba's cache can keep, so that a whole solution
is one compiled call.  The rows of these arrays are the columns of Fortran's: what is solved for
stands in rows.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
import numpy as np
from numba import njit, types
from numba.extending import get_cython_function_address
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError

Array = NDArray[np.float64]


def _external(module: str, name: str, arguments: int) -> Any:
    """A function that takes all its arguments by address, as Fortran has it."""
    symbol = f"cmp_tactile_{name}"
    llvm.add_symbol(symbol, get_cython_function_address(module, name))
    return types.ExternalFunction(symbol, types.void(*(types.voidptr,) * arguments))


_POTRF = _external("scipy.linalg.cython_lapack", "dpotrf", 5)
_TRSM = _external("scipy.linalg.cython_blas", "dtrsm", 11)
_LOWER, _FORWARD, _BACKWARD = ord("L"), ord("N"), ord("T")


@njit(cache=True, nogil=True, error_model="numpy")
def factor(matrix: Array) -> None:
    """Turn the upper triangle of a matrix (n, n) into R with R' R = matrix, in its place.

    Below the diagonal nothing is read or written.  Raises GeometryError for a matrix that is not
    definite.
    """
    _check(matrix, len(matrix))
    size, info = np.array([len(matrix)], dtype=np.int32), np.zeros(1, dtype=np.int32)
    _POTRF(_letter(_LOWER).ctypes, size.ctypes, matrix.ctypes, size.ctypes, info.ctypes)
    if info[0] != 0:
        raise GeometryError("matrix: found one that is not definite")


@njit(cache=True, nogil=True, error_model="numpy")
def forward(upper: Array, right: Array) -> None:
    """Solve R' x = b for the rows of right (k, n), in their place; R from `factor`."""
    _triangular(upper, right, _FORWARD)


@njit(cache=True, nogil=True, error_model="numpy")
def backward(upper: Array, right: Array) -> None:
    """Solve R x = b for the rows of right (k, n), in their place; R from `factor`."""
    _triangular(upper, right, _BACKWARD)


@njit(cache=True, nogil=True, error_model="numpy")
def _triangular(upper: Array, right: Array, transposed: int) -> None:
    _check(upper, len(upper))
    _check(right, len(upper))
    size = np.array([len(upper)], dtype=np.int32)
    rows, one = np.array([len(right)], dtype=np.int32), np.ones(1)
    _TRSM(
        _letter(_LOWER).ctypes, _letter(_LOWER).ctypes, _letter(transposed).ctypes,
        _letter(_FORWARD).ctypes, size.ctypes, rows.ctypes, one.ctypes, upper.ctypes, size.ctypes,
        right.ctypes, size.ctypes,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _letter(code: int) -> NDArray[np.uint8]:
    return np.array([code], dtype=np.uint8)


@njit(cache=True, nogil=True, error_model="numpy")
def _check(matrix: Array, columns: int) -> None:
    """Of another type, shape or order LAPACK would write beyond it."""
    if matrix.strides[0] != 8 * columns or matrix.strides[1] != 8:
        raise GeometryError("found another array than one of float64 with rows as long as R's")
