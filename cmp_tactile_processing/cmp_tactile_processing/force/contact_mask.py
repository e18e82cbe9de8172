"""Which nodes may bear a traction, as the first pass shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.sensor.parameters import ForceParameters

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

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
        self._shape = shape
        self._share = float(parameters.contact_threshold)
        self._floor = float(parameters.contact_pressure_floor * area)
        self._deviations = float(parameters.contact_deviations)

    def pressed(self, force: Array, normal_std: Array) -> Mask:
        """Nodes (n,) in contact: force (n, 3) N on the gel, normal_std (n,) N of its z."""
        return np.asarray(-force[:, 2] > np.maximum(self._least(force), self._noise(normal_std)))

    def loaded(self, force: Array, normal_std: Array) -> Mask:
        """Nodes (n,) that may bear a force: those pressed, pulled or dragged, and around them.

        force (n, 3) N on the gel, normal_std (n,) N of its z.
        """
        return self._widened(self.bearing(force, normal_std))

    def bearing(self, force: Array, normal_std: Array) -> Mask:
        """Nodes (n,) that are pressed, pulled or dragged, from the same arrays.

        Pulls and drags that reach opposite sides of the grid count as none: markers that have
        moved by no force, as from a reference of another day or in a row that is numbered wrongly,
        are explained by such.
        """
        pressed = self.pressed(force, normal_std)
        size = np.sqrt(np.einsum("ij,ij->i", force, force))
        noise = ANY_DIRECTION * self._noise(normal_std)
        others = (size > np.maximum(self._least(force), noise)) & ~pressed
        return pressed if self.spans(others) else pressed | others

    def spans(self, nodes: Mask) -> bool:
        """Whether nodes (n,) reach opposite sides of the grid."""
        grid = nodes.reshape(self._shape)
        between_rows = grid[0].any() and grid[-1].any()
        return bool(between_rows or (grid[:, 0].any() and grid[:, -1].any()))

    def edge(self, nodes: Mask) -> Mask:
        """Those of some nodes (n,) that have a neighbour on the grid which is none of them."""
        return np.asarray(nodes & self._widened(~nodes))

    def _least(self, force: Array) -> float:
        """What stands out of the rest and of the floor, N."""
        return max(self._share * float(np.abs(force).max(initial=0.0)), self._floor)

    def _noise(self, normal_std: Array) -> Array:
        return np.asarray(self._deviations * normal_std)

    def _widened(self, nodes: Mask) -> Mask:
        """With the four neighbours of each: what the resolution cuts off at a contact's edge."""
        grid = nodes.reshape(self._shape)
        found = grid.copy()
        found[1:] |= grid[:-1]
        found[:-1] |= grid[1:]
        found[:, 1:] |= grid[:, :-1]
        found[:, :-1] |= grid[:, 1:]
        return np.asarray(found.ravel())
