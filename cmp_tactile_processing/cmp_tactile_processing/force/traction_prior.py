"""What is expected of a traction before any marker has moved: it is smooth, and mostly normal.

The unknowns are coefficients: node j's coefficient, in N, is spread over the surface as a bilinear
hat.  What belongs to a node is the integral of the traction times that node's own hat, the
consistent nodal force of finite elements, which is what any other discretisation of the same
traction gives as well; the coefficients alone are not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.surface_grid import SurfaceGrid

__all__ = [
    "MIN_NOISE_SQUARED",
    "TANGENTIAL_SHARE",
    "gradient_penalty",
    "nodal_force_matrix",
    "smoothness",
]

# The noise is never taken for less than this share of what the parameters say, squared.
MIN_NOISE_SQUARED = 0.05**2
# A tangential traction is expected to be so large a share of the normal one: a usual friction.
TANGENTIAL_SHARE = 0.5


def nodal_force_matrix(nodes: SurfaceGrid) -> NDArray[np.float64]:
    """Matrix (n, n) from coefficients to consistent nodal forces, the same for every component.

    Each column sums to 1: what a hat at the edge spreads beyond the grid stays with its node.
    """
    lines = []
    for count in (nodes.rows, nodes.cols):
        line = _mass(count)
        line[np.diag_indices(count)] += 1 - line.sum(axis=0)
        lines.append(line)
    return np.asarray(np.kron(lines[0], lines[1]), np.float64)


def smoothness(nodes: SurfaceGrid, length: float) -> NDArray[np.float64]:
    """Precision (n, n) of one component's coefficients, of variance 1 in the middle of the grid.

    That of a Matern field, (1 - length^2 Laplace)^2, in the space of the hats, with a traction
    that falls to zero outside: restricted to some nodes it is the precision given that all other
    coefficients vanish (Lindgren, Rue and Lindstroem 2011).  length: m.
    """
    parts = []
    for count, spacing in ((nodes.rows, nodes.spacing[1]), (nodes.cols, nodes.spacing[0])):
        slope = 2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
        parts.append((_mass(count), slope * (length / spacing) ** 2))
    (mass_y, slope_y), (mass_x, slope_x) = parts
    mass = np.kron(mass_y, mass_x)
    operator = mass + np.kron(slope_y, mass_x) + np.kron(mass_y, slope_x)
    precision = operator @ np.linalg.solve(mass, operator)
    middle = (nodes.rows // 2) * nodes.cols + nodes.cols // 2
    unit = np.zeros(len(precision))
    unit[middle] = 1.0
    return np.asarray(precision * np.linalg.solve(precision, unit)[middle])


def gradient_penalty(nodes: SurfaceGrid, length: float) -> NDArray[np.float64]:
    """Integral of |t|^2 + length^2 |grad t|^2 over the coefficients, (3 n, 3 n) 1/m^2.

    t is the traction of coefficients of 1 N, which falls to zero one spacing outside the grid;
    length: m.
    """
    slopes = [
        (2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)) * (length / spacing) ** 2
        for count, spacing in zip((nodes.rows, nodes.cols), nodes.spacing[::-1], strict=True)
    ]
    mass_y, mass_x = _mass(nodes.rows), _mass(nodes.cols)
    one = np.kron(mass_y, mass_x) + np.kron(slopes[0], mass_x) + np.kron(mass_y, slopes[1])
    return np.asarray(np.kron(one / (nodes.spacing[0] * nodes.spacing[1]), np.eye(3)))


def _mass(count: int) -> NDArray[np.float64]:
    """Integrals of products of neighbouring hats, over their spacing."""
    return np.asarray(2 / 3 * np.eye(count) + (np.eye(count, k=1) + np.eye(count, k=-1)) / 6)
