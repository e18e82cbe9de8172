"""Second-order elements along a line: the tensor-product factors of loads and observations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["fold", "hat_loads", "interpolation", "interpolation_slope"]

# A node on the very edge of the block gets half a hat of this share of the spacing.
LEAST_REACH = 0.02


def interpolation(edges: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix (points, 2 elements + 1) that interpolates nodal values at `at`, inside the line."""
    element = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, len(edges) - 2)
    t = (at - edges[element]) / (edges[element + 1] - edges[element])
    matrix = np.zeros((len(at), 2 * len(edges) - 1))
    rows = np.arange(len(at))
    matrix[rows, 2 * element] = (1 - t) * (1 - 2 * t)
    matrix[rows, 2 * element + 1] = 4 * t * (1 - t)
    matrix[rows, 2 * element + 2] = t * (2 * t - 1)
    return matrix


def interpolation_slope(edges: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix (points, 2 elements + 1) from nodal values to the slope at `at`, inside the line."""
    element = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, len(edges) - 2)
    width = edges[element + 1] - edges[element]
    t = (at - edges[element]) / width
    matrix = np.zeros((len(at), 2 * len(edges) - 1))
    rows = np.arange(len(at))
    matrix[rows, 2 * element] = (4 * t - 3) / width
    matrix[rows, 2 * element + 1] = (4 - 8 * t) / width
    matrix[rows, 2 * element + 2] = (4 * t - 1) / width
    return matrix


def hat_loads(edges: NDArray[np.float64], nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Consistent nodal loads (2 elements + 1, nodes) of unit forces spread as hats over the nodes.

    A hat reaches one spacing to either side of its node, less where the line ends before that.
    The integrals are exact: each column sums to 1 and has its node as centroid.
    """
    spacing = nodes[1] - nodes[0]
    room = np.minimum(nodes - edges[0], edges[-1] - nodes)
    reach = np.clip(room, LEAST_REACH * spacing, spacing)
    breaks = np.concatenate([edges, nodes, nodes - reach, nodes + reach])
    breaks = np.unique(np.clip(breaks, edges[0], edges[-1]))
    gauss, gauss_weights = np.polynomial.legendre.leggauss(2)
    half = np.diff(breaks)[:, None] / 2
    points = ((breaks[:-1, None] + half) + half * gauss).ravel()
    weights = (half * gauss_weights).ravel()
    hats = np.maximum(0, 1 - np.abs(points[:, None] - nodes) / reach)
    loads = interpolation(edges, points).T @ (weights[:, None] * hats)
    return np.asarray(loads / loads.sum(axis=0))


def fold(matrix: NDArray[np.float64], sign: int) -> NDArray[np.float64]:
    """Columns of nodes at +x and -x joined: acts on values at x >= 0 of an even or odd function."""
    middle = matrix.shape[1] // 2
    folded: NDArray[np.float64] = matrix[:, middle:].copy()
    folded[:, 1:] += sign * matrix[:, middle - 1 :: -1]
    if sign < 0:
        folded[:, 0] = 0
    return folded
