"""Products with the inverse of a stiffness matrix whose unknowns form a chain of slices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cholesky, solve_triangular

__all__ = ["inverse_product"]


def inverse_product(
    matrix: sparse.csr_array,
    slices: Sequence[int],
    observers: sparse.csc_array,
    loads: sparse.csc_array,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`observers`.T @ inverse(`matrix`) @ `loads`, and `loads`.T @ inverse(`matrix`) @ `loads`.

    matrix: symmetric positive definite, and so is the second product if no loads are linearly
    dependent.

    slices: ascending bounds, from 0 to the size of the matrix; unknowns of one slice are coupled
    to those of the neighbouring slices alone.

    Block Cholesky with dense slices, which for a thin block beats a general sparse
    factorisation several times; no slice is kept longer than its neighbour needs it, so memory
    does not grow with the length of the chain.
    """
    columns = sparse.hstack([observers, loads], format="csr")
    first_load = observers.shape[1]
    product = np.zeros((columns.shape[1], loads.shape[1]))
    carried, carried_columns = 0.0, np.zeros((slices[1], columns.shape[1]))
    for start, stop, end in zip(slices, slices[1:], [*slices[2:], slices[-1]], strict=False):
        factor = cholesky(
            matrix[start:stop, start:stop].toarray() - carried, lower=True, check_finite=False
        )
        solved = columns[start:stop].toarray() - carried_columns
        # Columns that begin in a later slice are still zero here.
        active = np.flatnonzero(solved.any(axis=0))
        part = solve_triangular(factor, solved[:, active], lower=True, check_finite=False)
        of_load = active >= first_load
        product[np.ix_(active, active[of_load] - first_load)] += part.T @ part[:, of_load]
        if stop == end:
            break
        coupling = matrix[start:stop, stop:end]
        first = int(np.flatnonzero(np.diff(coupling.indptr))[0])
        link = solve_triangular(
            factor[first:, first:], coupling[first:].toarray(), lower=True, check_finite=False
        )
        carried = link.T @ link
        carried_columns = np.zeros((end - stop, columns.shape[1]))
        carried_columns[:, active] = link.T @ part[first:]
    return product[:first_load], product[first_load:]
