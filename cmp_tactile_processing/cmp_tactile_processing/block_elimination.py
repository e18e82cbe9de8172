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
    left: sparse.csc_array,
    right: sparse.csc_array,
) -> NDArray[np.float64]:
    """`left`.T @ inverse(`matrix`) @ `right` for a symmetric positive definite matrix.

    slices: ascending bounds, from 0 to the size of the matrix; unknowns of one slice are coupled
    to those of the neighbouring slices alone.

    Block Cholesky with dense slices, which for a thin block beats a general sparse
    factorisation several times; no slice is kept longer than its neighbour needs it, so memory
    does not grow with the length of the chain.
    """
    loads = sparse.hstack([left, right], format="csr")
    product = np.zeros((left.shape[1], right.shape[1]))
    carried, carried_loads = 0.0, np.zeros((slices[1], loads.shape[1]))
    for start, stop, end in zip(slices, slices[1:], [*slices[2:], slices[-1]], strict=False):
        factor = cholesky(
            matrix[start:stop, start:stop].toarray() - carried, lower=True, check_finite=False
        )
        solved = loads[start:stop].toarray() - carried_loads
        # Loads that begin in a later slice are still zero here.
        active = np.flatnonzero(solved.any(axis=0))
        part = solve_triangular(factor, solved[:, active], lower=True, check_finite=False)
        of_left = active < left.shape[1]
        rows, cols = active[of_left], active[~of_left] - left.shape[1]
        product[np.ix_(rows, cols)] += part[:, of_left].T @ part[:, ~of_left]
        if stop == end:
            break
        coupling = matrix[start:stop, stop:end]
        first = int(np.flatnonzero(np.diff(coupling.indptr))[0])
        link = solve_triangular(
            factor[first:, first:], coupling[first:].toarray(), lower=True, check_finite=False
        )
        carried = link.T @ link
        carried_loads = np.zeros((end - stop, loads.shape[1]))
        carried_loads[:, active] = link.T @ part[first:]
    return product
