"""Follows dots from frame to frame by the nearest one (paper, II.A)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from paper.dot_grid import UNKNOWN

__all__ = ["nearest_match"]


def nearest_match(
    points: NDArray[np.float64], last: NDArray[np.float64], gate: NDArray[np.float64]
) -> NDArray[np.intp]:
    """Index (M,) into points (N, 2) px of each marker, UNKNOWN where none is near enough.

    last (M, 2) px: where the markers were; gate (M,) px.  One to one, so that as many markers as
    possible find a dot, and the sum of the squared ways is the least.
    """
    index = np.full(len(last), UNKNOWN, np.intp)
    if not len(points):
        return index
    way = cdist(last, points) / gate[:, None]
    # Whoever goes without a dot costs more than any way through the gate.
    cost = np.where(way < 1, way**2, 10.0)
    markers, dots = linear_sum_assignment(cost)
    near = way[markers, dots] < 1
    index[markers[near]] = dots[near]
    return index
