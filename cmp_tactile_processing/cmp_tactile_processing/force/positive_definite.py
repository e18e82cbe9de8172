"""Cholesky factors, made and used while other Python threads run.

SciPy's own wrappers of these LAPACK and BLAS functions keep all other threads waiting; the same
functions, as it offers them to Cython, do not.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np
from numba.extending import get_cython_function_address
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError

__all__ = ["factor", "forward", "solve"]

Array = NDArray[np.float64]

# Module, name and number of arguments.
POTRF = "scipy.linalg.cython_lapack", "dpotrf", 5
TRSM = "scipy.linalg.cython_blas", "dtrsm", 11


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
