"""Resultant of nodal forces and its covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["material_covariance", "resultant_matrix"]


def resultant_matrix(place: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6, 3 n): force and moment about the origin of n nodal forces that act at `place` (n, 3)."""
    x, y, z = place.T
    zero, one = np.zeros(len(place)), np.ones(len(place))
    columns = np.array(
        [
            [one, zero, zero],
            [zero, one, zero],
            [zero, zero, one],
            [zero, -z, y],
            [z, zero, -x],
            [-y, x, zero],
        ]
    )
    return np.ascontiguousarray(columns.transpose(0, 2, 1).reshape(6, -1))


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
    tangential = np.array([force[0], force[1], 0.0])
    lifted = np.cross(place, tangential)
    lifted[2] = moment[2]
    by_tangential = np.concatenate([tangential, lifted])
    by_normal = wrench - by_tangential
    return np.asarray(
        normal_std**2 * np.outer(by_normal, by_normal)
        + tangential_std**2 * np.outer(by_tangential, by_tangential)
    )
