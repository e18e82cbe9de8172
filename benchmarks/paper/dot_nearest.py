"""Follows dots from frame to frame by the nearest one (paper, II.A), and by all of them at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from paper.dot_grid import UNKNOWN

__all__ = ["best_assignment", "nearest_match"]

# What it costs, in squared gates, to leave a marker without a dot: more than any way to one.
LEFT_OUT = 10.0


def nearest_match(
    points: NDArray[np.float64], last: NDArray[np.float64], gate: NDArray[np.float64]
) -> NDArray[np.intp]:
    """Index (M,) into points (N, 2) px of each marker, UNKNOWN where none is near enough.

    last (M, 2) px: where the markers were; gate (M,) px.  One to one: of all pairs that are left
    the closest is taken, again and again.
    """
    index = np.full(len(last), UNKNOWN, np.intp)
    if not len(points):
        return index
    way = cdist(last, points)
    markers, dots = np.nonzero(way < gate[:, None])
    free = np.ones(len(points), np.bool_)
    for k in np.argsort(way[markers, dots], kind="stable"):
        if index[markers[k]] == UNKNOWN and free[dots[k]]:
            index[markers[k]] = dots[k]
            free[dots[k]] = False
    return index


def best_assignment(
    points: NDArray[np.float64], last: NDArray[np.float64], gate: NDArray[np.float64]
) -> NDArray[np.intp]:
    """As `nearest_match`, but as many markers as possible find a dot, and the sum of the squared
    ways of all of them is the least."""
    index = np.full(len(last), UNKNOWN, np.intp)
    if not len(points):
        return index
    way = cdist(last, points) / gate[:, None]
    markers, dots = linear_sum_assignment(np.where(way < 1, way**2, LEFT_OUT))
    near = way[markers, dots] < 1
    index[markers[near]] = dots[near]
    return index
