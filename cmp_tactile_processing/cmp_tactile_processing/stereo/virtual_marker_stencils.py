"""Weights of the curves through the corners of a gridline, compiled; corners may be missing.

Between two corners a gridline is the cubic through the four corners nearest to them, as a function
of the material coordinate, which counts corners.  What that curve leaves out is about the next
term of Newton's interpolation formula: the divided difference of those four and a fifth corner.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["DEGREE_NODES", "NODES", "Stencils", "fill_stencils"]

Array = NDArray[np.float64]

# Corners that a curve goes through, and corners that it and its error are estimated from.
DEGREE_NODES, NODES = 4, 6
# A curve bridges at most so many segments: one missing corner; beyond the last one it never goes.
MOST_SEGMENTS_BRIDGED = 2
# Where there is no further corner: how large the next difference is, of the highest known.
NEXT_DIFFERENCE = 0.5


class Stencils(NamedTuple):
    """Weights of T segments with n virtual markers each.

    nodes (T, NODES): numbers of the corners along the gridline, -1 in front where there is no
    curve; value (T, n + 2, DEGREE_NODES): position at share k / (n + 1) of the segment, corners
    included; product (T, n + 2): of the distances to the nodes, in segments; divided
    (T, 2, NODES): mean and half the difference of the two divided differences, each over one
    further corner, that it multiplies in Newton's next term; known (T,): false where there is no
    further corner, and a share of the highest difference that there is stands for the next.
    """

    nodes: NDArray[np.int64]
    value: Array
    product: Array
    divided: Array
    known: NDArray[np.bool_]

    @classmethod
    def from_count(cls, count: int, n: int) -> Stencils:
        """Buffers for so many segments."""
        return cls(
            np.full((count, NODES), -1, np.int64),
            np.zeros((count, n + 2, DEGREE_NODES)),
            np.zeros((count, n + 2)),
            np.zeros((count, 2, NODES)),
            np.zeros(count, np.bool_),
        )


@njit(cache=True, nogil=True, error_model="numpy")
def fill_stencils(present: NDArray[np.bool_], first: int, stencils: Stencils) -> None:
    """Stencils of all segments of one gridline, into the entries from `first` on.

    present (corners,): which corners are there.
    """
    for segment in range(len(present) - 1):
        entry = first + segment
        nodes = stencils.nodes[entry]
        count = _choose(present, segment, nodes)
        if count == 0:
            continue
        degree = min(count, DEGREE_NODES)
        markers = stencils.value.shape[1] - 1
        for k in range(markers + 1):
            u = segment + k / markers
            product = 1.0
            for a in range(DEGREE_NODES):
                weight = 0.0
                if a < degree:
                    product *= u - nodes[a]
                    weight = 1.0
                    for b in range(degree):
                        if b != a:
                            weight *= (u - nodes[b]) / (nodes[a] - nodes[b])
                stencils.value[entry, k, a] = weight
            stencils.product[entry, k] = product
        stencils.known[entry] = count > degree
        _divide(nodes, count, stencils.divided[entry])


@njit(cache=True, nogil=True, error_model="numpy")
def _choose(present: NDArray[np.bool_], segment: int, nodes: NDArray[np.int64]) -> int:
    """Fill the nodes, nearest to the segment's middle first; how many there are, 0 for no curve."""
    count = 0
    before, after = -1, -1
    for reach in range(len(present)):
        for corner in (segment - reach, segment + 1 + reach):
            if count == NODES or not 0 <= corner < len(present) or not present[corner]:
                continue
            nodes[count] = corner
            count += 1
            if corner <= segment and before < 0:
                before = corner
            elif corner > segment and after < 0:
                after = corner
    if before < 0 or after < 0 or after - before > MOST_SEGMENTS_BRIDGED:
        nodes[0] = -1
        return 0
    for rest in range(count, NODES):
        nodes[rest] = nodes[0]
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _divide(nodes: NDArray[np.int64], count: int, divided: Array) -> None:
    """Weights of mean and half the difference of the next two divided differences."""
    degree = min(count, DEGREE_NODES)
    divided[:] = 0.0
    for which in range(2):
        further = min(degree + which, count - 1)
        known = further >= degree
        for a in range(count):
            if a >= degree and a != further:
                continue
            weight = 0.5 if known else 0.5 * NEXT_DIFFERENCE / degree
            for b in range(count):
                if b != a and (b < degree or b == further):
                    weight /= nodes[a] - nodes[b]
            divided[0, a] += weight
            divided[1, a] += weight if which == 0 else -weight
