"""Which nodes may bear a traction, as the first pass tells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from cmp_tactile_processing.parameters import ForceParameters

__all__ = ["CROSS", "ContactRule"]

# A node's four neighbours: what the resolution cuts off at the edge of a contact.
CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], dtype=bool)


class ContactRule:
    """Compares nodal forces with the noise, with their peak and with a floor.

    area (nodes,): seen along z, m^2, by which a nodal force along z is the normal pressure on a
    sloping surface, too.
    """

    def __init__(self, parameters: ForceParameters, shape: tuple[int, int], area: float) -> None:
        self._parameters = parameters
        self._shape = shape
        self._floor = parameters.contact_pressure_floor * area

    def pressed(
        self, force: NDArray[np.float64], normal_std: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Nodes (n,) in contact: force (n, 3) N on the gel, normal_std (n,) N of its z."""
        return self._stands_out(-force[:, 2], normal_std)

    def loaded(
        self, force: NDArray[np.float64], normal_std: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Nodes (n,) that may bear a force: those pressed or, where none is, pulled, and around."""
        found = self.pressed(force, normal_std)
        if not found.any():
            found = self._stands_out(np.linalg.norm(force, axis=1), normal_std)
        around = binary_dilation(found.reshape(self._shape), CROSS)
        return np.asarray(around.ravel())

    def _stands_out(self, size: NDArray[np.float64], std: NDArray[np.float64]) -> NDArray[np.bool_]:
        parameters = self._parameters
        least = max(parameters.contact_threshold * float(size.max()), self._floor)
        return np.asarray(size > np.maximum(least, parameters.contact_deviations * std))
