"""Products with the inverse of a sparse stiffness matrix, for loads on few unknowns each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cholesky, solve_triangular
from threadpoolctl import threadpool_limits

__all__ = ["Block", "inverse_product"]


@dataclass(frozen=True)
class Block:
    """Unknowns from `start` to `stop`, eliminated together once the blocks `children` are."""

    start: int
    stop: int
    children: tuple[int, ...]


@dataclass(frozen=True)
class _Update:
    """What eliminated unknowns leave behind on those later unknowns that they are coupled to.

    unknowns (b,) ascending, matrix (b, b); columns (a,) ascending: loads that touch them or
    what was eliminated, and their remains (b, a).
    """

    unknowns: NDArray[np.intp]
    matrix: NDArray[np.float64]
    columns: NDArray[np.intp]
    loads: NDArray[np.float64]


def inverse_product(
    matrix: sparse.csr_array,
    blocks: Sequence[Block],
    observers: sparse.csc_array,
    loads: sparse.csc_array,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`observers`.T @ inverse(`matrix`) @ `loads`, and `loads`.T @ inverse(`matrix`) @ `loads`.

    matrix: symmetric positive definite.  The second product is symmetric, and positive definite
    where no loads depend on one another.
    blocks: children before parents, together all unknowns in order.

    Multifrontal Cholesky (Duff and Reid 1983) with dense blocks that carries the observers and
    loads along.  Each of them meets only the few blocks from where it acts to the last one, and
    no factor is kept, which a general solver of many right-hand sides cannot make use of.
    """
    columns = sparse.hstack([observers, loads], format="csr")
    first_load = observers.shape[1]
    product = np.zeros((columns.shape[1], loads.shape[1]))
    pending: dict[int, _Update] = {}
    # The blocks are too small for more BLAS threads, which on loaded cores wait for one another.
    with threadpool_limits(1):
        for number, block in enumerate(blocks):
            updates = [pending.pop(child) for child in block.children]
            own = slice(block.start, block.stop)
            front = _assemble(matrix[own], columns[own], block, updates)
            pending[number], part = _eliminate(front, block.stop - block.start)
            of_load = front.columns >= first_load
            at = np.ix_(front.columns, front.columns[of_load] - first_load)
            product[at] += part.T @ part[:, of_load]
    return product[:first_load], product[first_load:]


def _assemble(
    rows: sparse.csr_array, columns: sparse.csr_array, block: Block, updates: list[_Update]
) -> _Update:
    """All that is known of the unknowns of a block and of those that they are coupled to."""
    known = [rows.indices, *(update.unknowns for update in updates)]
    coupled = np.unique(np.concatenate(known))
    own = np.arange(block.start, block.stop)
    unknowns = np.concatenate([own, coupled[coupled >= block.stop]])
    active = np.unique(np.concatenate([columns.indices, *(update.columns for update in updates)]))
    matrix = np.zeros((len(unknowns), len(unknowns)))
    loads = np.zeros((len(unknowns), len(active)))
    later = rows.indices >= block.start
    row = np.repeat(np.arange(len(own)), np.diff(rows.indptr))
    matrix[row[later], np.searchsorted(unknowns, rows.indices[later])] = rows.data[later]
    row = np.repeat(np.arange(len(own)), np.diff(columns.indptr))
    loads[row, np.searchsorted(active, columns.indices)] = columns.data
    for update in updates:
        at = np.searchsorted(unknowns, update.unknowns)
        matrix[np.ix_(at, at)] += update.matrix
        loads[np.ix_(at, np.searchsorted(active, update.columns))] += update.loads
    return _Update(unknowns, matrix, active, loads)


def _eliminate(front: _Update, count: int) -> tuple[_Update, NDArray[np.float64]]:
    """What is left without the first `count` unknowns, and the loads' share in these."""
    factor = cholesky(front.matrix[:count, :count], lower=True, check_finite=False)
    link = solve_triangular(factor, front.matrix[:count, count:], lower=True, check_finite=False)
    part = solve_triangular(factor, front.loads[:count], lower=True, check_finite=False)
    matrix, loads = front.matrix[count:, count:], front.loads[count:]
    # In place: these are the largest arrays of all.
    matrix -= link.T @ link
    loads -= link.T @ part
    return _Update(front.unknowns[count:], matrix, front.columns, loads), part
