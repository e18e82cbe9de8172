"""Splitting of fields over a rectangle into parts that are even or odd in x and in y.

A block that is its own mirror image in x and in y answers each part by itself, so that a quarter
of it, solved four times, stands for the whole.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cmp_tactile_processing.elastic.sparse_rows import SparseRows
from cmp_tactile_processing.measured.surface_grid import SurfaceGrid

__all__ = ["PARITIES", "Parity", "mirrored_response"]


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


PARITIES = tuple(Parity(x, y) for x in (1, -1) for y in (1, -1))


def mirrored_response(
    responses: Iterable[NDArray[np.float64]],
    source: SurfaceGrid,
    target: SurfaceGrid,
    values: NDArray[np.float64],
) -> NDArray[np.float64]:
    """What values (3 source,) cause on the whole target grid, (3 target,).

    responses: one per parity, of the target's quarter to unit parts on the source's quarter, in
    single or double precision.
    """
    folded = _folds(source.rows, source.cols).of_vector(values)
    parts = folded.reshape(len(PARITIES), -1)
    moved = [
        response @ part.astype(response.dtype)
        for response, part in zip(responses, parts, strict=True)
    ]
    return _unfolds(target.rows, target.cols).of_vector(np.concatenate(moved))


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
    total = None
    for component in range(3):
        points = sparse.kron(
            _extend(rows, parity.sign_y(component)), _extend(cols, parity.sign_x(component))
        )
        part = sparse.kron(points, np.diag(np.arange(3) == component).astype(np.float64))
        total = part if total is None else total + part
    whole = sparse.csr_array(total)
    whole.data.flags.writeable = False
    return whole


def _extend(count: int, sign: int) -> NDArray[np.float64]:
    """Values at the upper half of a symmetric line -> values on all of it, (count, half)."""
    start = count // 2
    matrix = np.zeros((count, count - start))
    for index in range(start, count):
        mirrored = count - 1 - index
        matrix[mirrored, index - start] = sign
        matrix[index, index - start] = 1 if index != mirrored or sign > 0 else 0
    return matrix
