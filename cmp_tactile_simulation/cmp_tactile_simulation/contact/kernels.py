"""Compiled loops of the contact solver: products with the compliance, and its condensed system.

Their results do not depend on how many nodes the compliance holds beyond those asked for, so
that a simulation gives the same numbers wherever it begins.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["condensed_system", "response"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@njit(cache=True, nogil=True)
def response(compliance: Array, at: Index, loaded: Index, force: Array) -> Array:
    """Displacement (k, 3) at nodes `at` under forces (l, 3) on the nodes `loaded`.

    at, loaded: numbers of nodes in the compliance (3 m, 3 m).
    """
    moved = np.zeros((len(at), 3))
    for i in range(len(at)):
        for a in range(3):
            row = compliance[3 * at[i] + a]
            total = 0.0
            for j in range(len(loaded)):
                first = 3 * loaded[j]
                total += row[first] * force[j, 0]
                total += row[first + 1] * force[j, 1]
                total += row[first + 2] * force[j, 2]
            moved[i, a] = total
    return moved


@njit(cache=True, nogil=True)
def condensed_system(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    compliance: Array, nodes: Index, first: Index, test: Array, trial: Array, local: Array
) -> NDArray[np.float32]:
    """Matrix (m, m) of test[r] . compliance . trial[c] between the unknowns of the nodes.

    nodes: (k,) numbers in the compliance.  first: (k + 1,) node i has the unknowns from first[i]
    to first[i + 1].  test, trial: (m, 3) directions.  local: (m, 3), local[r] . trial[c] is
    added between unknowns of one node.  Single precision is enough: the solver iterates on a
    residual in double precision.
    """
    count = len(test)
    matrix = np.empty((count, count), dtype=np.float32)
    for i in range(len(nodes)):
        rows = compliance[3 * nodes[i] : 3 * nodes[i] + 3]
        for r in range(first[i], first[i + 1]):
            t0, t1, t2 = test[r]
            for j in range(len(nodes)):
                c = 3 * nodes[j]
                w0 = t0 * rows[0, c] + t1 * rows[1, c] + t2 * rows[2, c]
                w1 = t0 * rows[0, c + 1] + t1 * rows[1, c + 1] + t2 * rows[2, c + 1]
                w2 = t0 * rows[0, c + 2] + t1 * rows[1, c + 2] + t2 * rows[2, c + 2]
                for q in range(first[j], first[j + 1]):
                    matrix[r, q] = w0 * trial[q, 0] + w1 * trial[q, 1] + w2 * trial[q, 2]
            for q in range(first[i], first[i + 1]):
                matrix[r, q] += np.dot(local[r], trial[q])
    return matrix
