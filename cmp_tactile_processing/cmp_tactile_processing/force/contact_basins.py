"""Separate hills of a map of pressure: a watershed that keeps together what high passes join."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["basins"]


def basins(
    pressure: NDArray[np.float64], inside: NDArray[np.bool_], merge_ratio: float
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Number the hills of `pressure` (rows, cols) within the mask `inside` from 1; 0 is outside.

    Two hills that touch, sides or corners, are one where the highest pass between them reaches
    `merge_ratio` of the lower one's peak.  Returns the numbers (rows, cols) and, per hill, the
    lowest pass that joined its parts, inf where it is of one piece.
    """
    nodes = np.flatnonzero(inside)
    order = nodes[np.argsort(-pressure.ravel()[nodes], kind="stable")]
    number = np.zeros(pressure.size, dtype=np.intp)
    passes = np.full(len(order) + 1, np.inf)
    count = _flood(pressure.ravel(), order, pressure.shape[1], merge_ratio, number, passes)
    return number.reshape(pressure.shape), passes[1 : count + 1]


@njit(cache=True, nogil=True, error_model="numpy")
def _flood(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    pressure: Any, order: Any, cols: int, merge_ratio: float, number: Any, passes: Any
) -> int:
    """Number the nodes, which come from the highest down; returns how many hills there are."""
    rows = len(number) // cols
    parent = np.zeros(len(order) + 1, dtype=np.intp)
    peak = np.zeros(len(order) + 1)
    found = 0
    for node in order:
        row, col = node // cols, node % cols
        home = 0
        for i in range(max(row - 1, 0), min(row + 2, rows)):
            for j in range(max(col - 1, 0), min(col + 2, cols)):
                other = number[i * cols + j]
                if other == 0:
                    continue
                other = _root(parent, other)
                if home in (0, other):
                    home = other
                    continue
                high, low = (home, other) if peak[home] >= peak[other] else (other, home)
                if pressure[node] >= merge_ratio * peak[low]:
                    parent[low] = high
                    passes[high] = min(passes[high], passes[low], pressure[node])
                home = high
        if home == 0:
            found += 1
            home = found
            parent[home], peak[home] = home, pressure[node]
        number[node] = home
    return _renumber(parent, passes, found, order, number)


@njit(cache=True, nogil=True, error_model="numpy")
def _root(parent: Any, hill: int) -> int:
    while parent[hill] != hill:
        hill = parent[hill]
    return hill


@njit(cache=True, nogil=True, error_model="numpy")
def _renumber(parent: Any, passes: Any, found: int, order: Any, number: Any) -> int:
    """Give the hills that remain the numbers from 1 on."""
    final = np.zeros(found + 1, dtype=np.intp)
    count = 0
    for hill in range(1, found + 1):
        if parent[hill] == hill:
            count += 1
            final[hill] = count
            passes[count] = passes[hill]
    for node in order:
        number[node] = final[_root(parent, number[node])]
    return count
