"""Resultant of nodal forces and its covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["material_covariance", "resultant_matrix", "wrench_of"]


def resultant_matrix(
    place: NDArray[np.float64], weight: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """(6, 3 n): force and moment about the origin of n nodal forces that act at `place` (n, 3).

    With weights (n,) each force counts so often, and place (n, 3) holds weight times place.
    """
    count = len(place)
    found = np.zeros((6, count, 3))
    one = np.ones(count) if weight is None else weight
    x, y, z = place.T
    for component in range(3):
        found[component, :, component] = one
    found[3, :, 1], found[3, :, 2] = -z, y
    found[4, :, 0], found[4, :, 2] = z, -x
    found[5, :, 0], found[5, :, 1] = -y, x
    return found.reshape(6, -1)


def wrench_of(force: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Force and moment about the origin (6,) of nodal forces (n, 3) that act at `place` (n, 3)."""
    # The moment from the products' sums: numpy.cross takes longer than all the rest.
    product = place.T @ force
    moment = product.T[[2, 0, 1], [1, 2, 0]] - product.T[[1, 2, 0], [2, 0, 1]]
    return np.concatenate([force.sum(axis=0), moment])


def material_covariance(
    wrench: NDArray[np.float64],
    place: NDArray[np.float64],
    normal_std: float,
    tangential_std: float,
) -> NDArray[np.float64]:
    """Covariance (6, 6) of a wrench whose normal and tangential scale are not quite known.

    normal_std, tangential_std: relative.  The moments follow the forces that make them: those of
    the normal force about x and y, those of the tangential force at height place (3,) m as well.
    """
    force, moment = wrench[:3], wrench[3:]
    x, y, height = force[0], force[1], place[2]
    by_tangential = np.array([x, y, 0.0, -height * y, height * x, moment[2]])
    by_normal = wrench - by_tangential
    return np.asarray(
        normal_std**2 * np.outer(by_normal, by_normal)
        + tangential_std**2 * np.outer(by_tangential, by_tangential)
    )
