"""Which nodes may bear a traction, as the first pass shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part, plain
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
        floor = float(parameters.contact_pressure_floor * area)
        share, deviations = parameters.contact_threshold, parameters.contact_deviations
        self._limits = float(share), floor, float(deviations)
        # Compiled here, before the first frame.
        self.loaded(np.zeros((shape[0] * shape[1], 3)), np.ones(shape[0] * shape[1]))

    def pressed(self, force: Array, normal_std: Array) -> Mask:
        """Nodes (n,) in contact: force (n, 3) N on the gel, normal_std (n,) N of its z."""
        return _bearing(force, plain(normal_std, np.float64), self._limits, self._shape)[0]

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
        return _bearing(force, plain(normal_std, np.float64), self._limits, self._shape)[1]

    def spans(self, nodes: Mask) -> bool:
        """Whether nodes (n,) reach opposite sides of the grid."""
        return _spans(nodes.reshape(self._shape))

    def edge(self, nodes: Mask) -> Mask:
        """Those of some nodes (n,) that have a neighbour on the grid which is none of them."""
        return np.asarray(nodes & _widened(~nodes, self._shape))


@kernel
def _bearing(
    force: Array, normal_std: Array, limits: tuple[float, float, float], shape: tuple[int, int]
) -> tuple[Mask, Mask]:
    """Nodes (n,) that are pressed, and those that bear anything, as the methods of ContactRule.

    limits: share of the peak, floor in N, and deviations.
    """
    share, floor, deviations = limits
    least, count = floor, len(force)
    for n in range(count):
        for c in range(3):
            least = max(least, share * abs(force[n, c]))
    pressed, others = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    for n in range(count):
        noise = deviations * normal_std[n]
        pressed[n] = -force[n, 2] > max(least, noise)
        size = np.sqrt(force[n, 0] ** 2 + force[n, 1] ** 2 + force[n, 2] ** 2)
        others[n] = not pressed[n] and size > max(least, ANY_DIRECTION * noise)
    if _spans(others.reshape(shape)):
        return pressed, pressed.copy()
    return pressed, pressed | others


@kernel_part
def _spans(grid: Mask) -> bool:
    """As ContactRule.spans; grid (rows, cols)."""
    between_rows = bool(grid[0].any() and grid[-1].any())
    return between_rows or bool(grid[:, 0].any() and grid[:, -1].any())


@kernel
def _widened(nodes: Mask, shape: tuple[int, int]) -> Mask:
    """With the four neighbours of each: what the resolution cuts off at a contact's edge."""
    rows, cols = shape
    found: Mask = nodes.copy()
    for n in range(len(nodes)):
        if nodes[n]:
            i, j = n // cols, n % cols
            found[n - cols if i > 0 else n] = True
            found[n + cols if i + 1 < rows else n] = True
            found[n - 1 if j > 0 else n] = True
            found[n + 1 if j + 1 < cols else n] = True
    return found
