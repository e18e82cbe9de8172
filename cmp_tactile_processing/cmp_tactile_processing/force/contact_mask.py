"""Which nodes may bear a traction, as the first pass shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from cmp_tactile_processing.sensor.parameters import ForceParameters

# A node's four neighbours: what the resolution cuts off at the edge of a contact.
CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], dtype=bool)
# A force in any direction has three components to stand out of the noise with, and the first pass
# rings by up to 4.5 deviations around a load; a press has one.
ANY_DIRECTION = 5 / 3


class ContactRule:
    """Compares nodal forces with the noise, with their peak and with a floor.

    The peak is the largest component in any direction, as what rings around a pull or a drag is
    no contact.  area: of one node, seen along z, m^2, by which a nodal force along z is the normal
    pressure on a sloping surface, too.
    """

    def __init__(self, parameters: ForceParameters, shape: tuple[int, int], area: float) -> None:
        self._parameters = parameters
        self._shape = shape
        self._floor = parameters.contact_pressure_floor * area

    def pressed(
        self, force: NDArray[np.float64], normal_std: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Nodes (n,) in contact: force (n, 3) N on the gel, normal_std (n,) N of its z."""
        least = self._parameters.contact_deviations * normal_std
        return np.asarray(-force[:, 2] > np.maximum(self._least(force), least))

    def loaded(
        self, force: NDArray[np.float64], normal_std: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Nodes (n,) that may bear a force: those pressed, pulled or dragged, and around them.

        force (n, 3) N on the gel, normal_std (n,) N of its z.
        """
        found = self.bearing(force, normal_std).reshape(self._shape)
        return np.asarray(binary_dilation(found, CROSS).ravel())

    def bearing(
        self, force: NDArray[np.float64], normal_std: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Nodes (n,) that are pressed, pulled or dragged, from the same arrays.

        Pulls and drags that reach opposite sides of the grid count as none: markers that have
        moved by no force, as from a reference of another day or in a row that is numbered wrongly,
        are explained by such.
        """
        size = np.linalg.norm(force, axis=1)
        least = ANY_DIRECTION * self._parameters.contact_deviations * normal_std
        pressed = self.pressed(force, normal_std)
        others = (size > np.maximum(self._least(force), least)) & ~pressed
        return pressed if self.spans(others) else pressed | others

    def spans(self, nodes: NDArray[np.bool_]) -> bool:
        """Whether nodes (n,) reach opposite sides of the grid."""
        grid = nodes.reshape(self._shape)
        across = grid[0].any() and grid[-1].any(), grid[:, 0].any() and grid[:, -1].any()
        return bool(any(across))

    def _least(self, force: NDArray[np.float64]) -> float:
        return max(self._parameters.contact_threshold * float(np.abs(force).max()), self._floor)
