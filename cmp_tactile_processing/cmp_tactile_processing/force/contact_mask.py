"""Which nodes may bear a traction, as the first pass shows."""

from __future__ import annotations

import numpy as np
from numba import njit
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
        self._limits = (
            float(parameters.contact_threshold),
            float(parameters.contact_pressure_floor * area),
            float(parameters.contact_deviations),
        )
        # Compiled, or read from numba's cache, before the first frame.
        nothing = np.zeros((shape[0] * shape[1], 3))
        for rule in (self.pressed, self.bearing, self.loaded):
            self.edge(rule(nothing, nothing[:, 0].copy()))

    def pressed(self, force: Array, normal_std: Array) -> Mask:
        """Nodes (n,) in contact: force (n, 3) N on the gel, normal_std (n,) N of its z."""
        return _pressed(force, np.ascontiguousarray(normal_std), self._limits)

    def loaded(self, force: Array, normal_std: Array) -> Mask:
        """Nodes (n,) that may bear a force: those pressed, pulled or dragged, and around them.

        force (n, 3) N on the gel, normal_std (n,) N of its z.
        """
        return _widened(self.bearing(force, normal_std), self._shape)

    def bearing(self, force: Array, normal_std: Array) -> Mask:
        """Nodes (n,) that are pressed, pulled or dragged, from the same arrays.

        Pulls and drags that reach opposite sides of the grid count as none: markers that have
        moved by no force, as from a reference of another day or in a row that is numbered wrongly,
        are explained by such.
        """
        return _bearing(force, np.ascontiguousarray(normal_std), self._limits, self._shape)

    def spans(self, nodes: Mask) -> bool:
        """Whether nodes (n,) reach opposite sides of the grid."""
        return bool(_spans(nodes, self._shape))

    def edge(self, nodes: Mask) -> Mask:
        """Those of some nodes (n,) that have a neighbour on the grid which is none of them."""
        return nodes & _widened(~nodes, self._shape)


@njit(cache=True, nogil=True, error_model="numpy")
def _least(force: Array, limits: tuple[float, float, float]) -> float:
    """What stands out of the rest and of the floor, N."""
    peak = 0.0
    for node in range(len(force)):
        for c in range(3):
            peak = max(peak, abs(force[node, c]))
    return max(limits[0] * peak, limits[1])


@njit(cache=True, nogil=True, error_model="numpy")
def _pressed(force: Array, normal_std: Array, limits: tuple[float, float, float]) -> Mask:
    """As ContactRule.pressed; limits: share of the peak, floor in N, deviations of the noise."""
    least = _least(force, limits)
    found: Mask = np.empty(len(force), dtype=np.bool_)
    for node in range(len(force)):
        found[node] = -force[node, 2] > max(least, limits[2] * normal_std[node])
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _bearing(
    force: Array,
    normal_std: Array,
    limits: tuple[float, float, float],
    shape: tuple[int, int],
) -> Mask:
    """As ContactRule.bearing; limits: see _pressed."""
    pressed = _pressed(force, normal_std, limits)
    least, deviations = _least(force, limits), ANY_DIRECTION * limits[2]
    others: Mask = np.zeros(len(force), dtype=np.bool_)
    for node in range(len(force)):
        size = np.sqrt(force[node, 0] ** 2 + force[node, 1] ** 2 + force[node, 2] ** 2)
        stands_out = size > max(least, deviations * normal_std[node])
        others[node] = stands_out and not pressed[node]
    return pressed if _spans(others, shape) else pressed | others


@njit(cache=True, nogil=True, error_model="numpy")
def _spans(nodes: Mask, shape: tuple[int, int]) -> bool:
    grid = nodes.reshape(shape)
    between_rows = grid[0].any() and grid[-1].any()
    between_columns = grid[:, 0].any() and grid[:, -1].any()
    return bool(between_rows or between_columns)


@njit(cache=True, nogil=True, error_model="numpy")
def _widened(nodes: Mask, shape: tuple[int, int]) -> Mask:
    """With the four neighbours of each: what the resolution cuts off at the edge of a contact."""
    rows, cols = shape
    found: Mask = nodes.copy()
    for i in range(rows):
        for j in range(cols):
            if nodes[i * cols + j]:
                found[max(i - 1, 0) * cols + j] = True
                found[min(i + 1, rows - 1) * cols + j] = True
                found[i * cols + max(j - 1, 0)] = True
                found[i * cols + min(j + 1, cols - 1)] = True
    return found
