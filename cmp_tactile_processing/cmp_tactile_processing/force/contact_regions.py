"""The separate contacts of a force field: their wrenches, areas, centres and outlines.

Contacts are hills of a map of pressure, parted by a watershed that keeps together what high passes
join.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part, plain
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.force.outline import outline
from cmp_tactile_processing.measured import Contact, SurfaceGrid

# These were fitted to 105 contacts of balls, punches, cuboids, cylinders and rings at 0.5 to 10 N,
# which were solved on a finer mesh and reconstructed from noisy markers.


Array = NDArray[np.float64]

# Hills of pressure that touch are one contact where the pass between them reaches this share of
# the lower peak: what the limited resolution makes of a gap between two contacts is lower, what
# noise makes of one contact's pressure is higher.
MERGE_RATIO = 0.4
# A hill is a contact if its normal force is at least this share of the strongest contact's (smaller
# ones may be errors of the reconstruction), and this many of its own standard deviations.
MIN_CONTACT_SHARE = 0.01
MIN_CONTACT_DEVIATIONS = 3.0

Mask = NDArray[np.bool_]
Numbers = NDArray[np.intp]


@kernel
def resultant_matrix(weights: Array) -> Array:
    """(6 s, 3 n): force and moment about the origin of n nodal forces, s times.

    weights (n, s, 4): where they act, x, y and z times their weight, and the weight.
    """
    count, sets = weights.shape[:2]
    found: Array = np.zeros((6 * sets, 3 * count))
    for n in range(count):
        for s in range(sets):
            x, y, z = weights[n, s, 0], weights[n, s, 1], weights[n, s, 2]
            of_set = found[6 * s : 6 * s + 6, 3 * n : 3 * n + 3]
            for axis in range(3):
                of_set[axis, axis] = weights[n, s, 3]
            of_set[3, 1], of_set[3, 2] = -z, y
            of_set[4, 0], of_set[4, 2] = z, -x
            of_set[5, 0], of_set[5, 1] = -y, x
    return found


@kernel
def wrench_of(force: Array, place: Array, nodes: Numbers) -> Array:
    """Force and moment about the origin (6,) of the forces of some nodes.

    force (M, 3) N, place (M, 3) m: where they act, of all nodes; nodes (k,): numbers.
    """
    wrench: Array = np.zeros(6)
    for n in nodes:
        for c in range(3):
            a, b = (c + 1) % 3, (c + 2) % 3
            wrench[c] += force[n, c]
            wrench[3 + c] += place[n, a] * force[n, b] - place[n, b] * force[n, a]
    return wrench


@kernel_part
def centre_of_forces(force: Array, place: Array, nodes: Numbers) -> tuple[Array, float]:
    """Mean place (3,) m of the forces of some nodes (k,), weighted by size, and the sum of sizes.

    force (M, 3) N, place (M, 3) m: of all nodes; the origin where there is no force.
    """
    centre, total = np.zeros(3), 0.0
    for n in nodes:
        size = np.sqrt(force[n, 0] ** 2 + force[n, 1] ** 2 + force[n, 2] ** 2)
        total += size
        for c in range(3):
            centre[c] += size * place[n, c]
    if total > 0:
        centre /= total
    return centre, total


@kernel_part
def material_covariance(
    wrench: Array, place: Array, normal_std: float, tangential_std: float
) -> Array:
    """Covariance (6, 6) of a wrench of not quite known normal and tangential scale.

    normal_std, tangential_std: relative.  The moments follow the forces that make them: those of
    the normal force about x and y, those of the tangential force at height place (3,) m as well.
    """
    x, y, height = wrench[0], wrench[1], place[2]
    by_tangential = x, y, 0.0, -height * y, height * x, wrench[5]
    covariance: Array = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            by_normal = (wrench[i] - by_tangential[i]) * (wrench[j] - by_tangential[j])
            covariance[i, j] = normal_std**2 * by_normal
            covariance[i, j] += tangential_std**2 * by_tangential[i] * by_tangential[j]
    return covariance


def basins(
    pressure: NDArray[np.float64], inside: NDArray[np.bool_], merge_ratio: float
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Number the hills of `pressure` (rows, cols) within the mask `inside` from 1; 0 is outside.

    Two hills that touch, sides or corners, are one where the highest pass between them reaches
    `merge_ratio` of the lower one's peak.  Returns the numbers (rows, cols) and, per hill, the
    lowest pass that joined its parts, inf where it is of one piece.
    """
    nodes, heights = np.flatnonzero(inside), pressure.astype(np.float64).reshape(-1)
    order = nodes[np.argsort(-heights[nodes], kind="stable")]
    number = np.zeros(pressure.size, dtype=np.intp)
    passes = np.full(len(order) + 1, np.inf)
    count = _flood(heights, order, pressure.shape[1], merge_ratio, number, passes)
    return number.reshape(pressure.shape), passes[1 : count + 1]


@kernel
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


@kernel_part
def _root(parent: Any, hill: int) -> int:
    while parent[hill] != hill:
        hill = parent[hill]
    return hill


@kernel_part
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


class Hills(NamedTuple):
    """The hills of pressure of a frame, each of which may be a contact.

    nodes: of each hill, numbers (K,).  pressing (hills,) N: their normal forces.  passes (hills,):
    the lowest pass that joined the parts of each, inf where it is of one piece.
    force, place (M, 3).  mask (M,): nodes in contact.  pressure (rows, cols).
    """

    nodes: list[Numbers]
    pressing: Array
    passes: Array
    force: Array
    place: Array
    mask: Mask
    pressure: Array


class ContactRegions:
    """Finds the separate contacts on a grid of force nodes.

    nodes: the grid.  node_area (M,) m^2: undeformed contact surface that belongs to each node.
    border (M,): the outermost nodes.  Raises InputError where the two do not belong together.
    """

    def __init__(self, nodes: SurfaceGrid, node_area: NDArray[np.float64]) -> None:
        rows, cols = self._shape = nodes.rows, nodes.cols
        self._area = np.asarray(node_area, dtype=np.float64)
        if self._area.shape != (rows * cols,):
            msg = f"node_area: found shape {self._area.shape}, expected {(rows * cols,)}"
            raise InputError(msg)
        border = np.ones(self._shape, dtype=bool)
        border[1:-1, 1:-1] = False
        self.border = border.ravel()

    def hills(self, force: Array, contact: Mask, place: Array) -> Hills:
        """What may be a contact.

        force (M, 3) N per node, on the gel; contact (M,): nodes in contact; place (M, 3) m: where
        the forces act, on the deformed surface.

        A hill is of nodes in contact that touch, sides or corners, but for those that a deep pass
        parts.  To it belong those next to it that bear the rest of its force, so that the hills'
        wrenches add up to that of all nodes.  Nodes without a finite force belong to none; a hill
        with less than 1 % of the strongest one's normal force is none.
        """
        force, place = plain(force, np.float64), plain(place, np.float64)
        pressure, mask, loaded = _pressure(force, place, np.asarray(contact, np.bool_), self._area)
        grid = pressure.reshape(self._shape)
        numbers, passes = basins(grid, mask.reshape(self._shape), MERGE_RATIO)
        owner, pressing = _owner(numbers, grid, loaded.reshape(self._shape), force, len(passes))
        large = np.flatnonzero(pressing > MIN_CONTACT_SHARE * pressing.max(initial=0.0))
        nodes = [np.flatnonzero(owner == hill + 1) for hill in large]
        return Hills(nodes, pressing[large], passes[large], force, place, mask, grid)

    def contacts(
        self, hills: Hills, covariances: Sequence[tuple[Array, Array]]
    ) -> tuple[Contact, ...]:
        """Separate contacts, that of the largest normal force first.

        covariances: for each hill (6, 6) of its wrench, of noise alone and what comes to it.  A
        hill with a normal force that does not stand out of the noise is none.

        The outline follows a level of the normal pressure between the nodes, closed along the
        border of the grid where the contact goes on beyond it.  Of a ring it is the outer edge;
        its hole is left out of the area, as the area is what lies above that level.
        Reconstructed from noisy markers, the areas of balls are right within 10 % and the outlines
        within 0.1 to 0.3 spacings of the nodes.  Areas of flat ends, edges and rings six spacings
        wide or more are right within 20 %.  Narrower ones are rounded off like a ball: their area
        is a fifth to a half too large.  Two contacts are found apart when their edges are 0.7
        spacings from each other.
        """
        force, place, found = hills.force, hills.place, []
        for k, (nodes, (noise, more)) in enumerate(zip(hills.nodes, covariances, strict=True)):
            if hills.pressing[k] ** 2 < MIN_CONTACT_DEVIATIONS**2 * noise[2, 2]:
                continue
            shape = _shape(
                force, place, hills.mask, hills.pressure, nodes, self._area, hills.passes[k]
            )
            wrench = wrench_of(force, place, nodes)
            found.append(Contact(nodes, wrench, noise + more, *shape))
        return tuple(sorted(found, key=lambda item: item.wrench[2]))


@kernel
def _pressure(force: Array, place: Array, contact: Mask, area: Array) -> tuple[Array, Mask, Mask]:
    """Normal pressure at the nodes (M,), which of them are in contact, and which bear a force.

    area (M,): of the nodes.  Where a force or its place is not known there is none.
    """
    pressure = np.zeros(len(force))
    mask, loaded = np.zeros(len(force), np.bool_), np.zeros(len(force), np.bool_)
    for n in range(len(force)):
        known, some = True, False
        for c in range(3):
            known &= np.isfinite(force[n, c]) and np.isfinite(place[n, c])
            some |= force[n, c] != 0
        if known:
            pressure[n] = -force[n, 2] / area[n]
            mask[n], loaded[n] = contact[n], some
    return pressure, mask, loaded


@kernel
def _shape(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    force: Array, place: Array, mask: Mask, pressure: Array, nodes: Numbers, area: Array,
    lowest_pass: float,
) -> tuple[float, Array, Array, bool]:  # fmt: skip
    """Area, centre of pressure (3,) and outline (L, 3) of a hill, and whether it is at the border.

    Arrays as in Hills; nodes (K,): those of the hill; area (M,): of all nodes.
    """
    rows, cols = pressure.shape
    centre, height = np.zeros(3), np.zeros((rows + 2, cols + 2))
    total = core_area = core_force = 0.0
    count, at_border = 0, False
    for n in nodes:
        i, j = n // cols, n % cols
        pressing = max(-force[n, 2], 0.0)
        total += pressing
        for c in range(3):
            centre[c] += pressing * place[n, c]
        height[i + 1, j + 1] = max(pressure[i, j], 0.0)
        if mask[n]:
            core_area, core_force, count = core_area + area[n], core_force - force[n, 2], count + 1
            at_border |= i in (0, rows - 1) or j in (0, cols - 1)
    # On a sloping surface -f_z per area is not quite the pressure: it only sets the level.
    points, cells = outline(height, core_force / core_area, lowest_pass * (1 - 1e-9))
    centre = centre / total if total > 0 else np.full(3, np.nan)
    return cells * core_area / count, centre, _lifted(points, place, rows, cols), at_border


@kernel_part
def _lifted(points: Array, place: Array, rows: int, cols: int) -> Array:
    """Points (L, 2) as (col, row) on the deformed surface, (L, 3) m, linear between nodes."""
    lifted: Array = np.empty((len(points), 3))
    for k in range(len(points)):
        col, row = points[k]
        j, i = min(int(col), cols - 2), min(int(row), rows - 2)
        u, v, first = col - j, row - i, i * cols + j
        for c in range(3):
            lower = (1 - u) * place[first, c] + u * place[first + 1, c]
            upper = (1 - u) * place[first + cols, c] + u * place[first + cols + 1, c]
            lifted[k, c] = (1 - v) * lower + v * upper
    return lifted


@kernel
def _owner(
    numbers: Numbers, pressure: Array, loaded: Mask, force: Array, hills: int
) -> tuple[Numbers, Array]:
    """The hill (M,) from 1 that each node belongs to, and the normal forces (hills,) of these.

    numbers, pressure, loaded (rows, cols).  To a hill belong loaded nodes beside it, too: to that
    of the highest one of their neighbours.
    """
    rows, cols = numbers.shape
    owner: Numbers = numbers.copy().reshape(-1)
    pressing = np.zeros(hills)
    for i in range(rows):
        for j in range(cols):
            node, best = i * cols + j, -np.inf
            around = numbers[i, j] == 0 and loaded[i, j]
            for k in range(max(i - 1, 0), min(i + 2, rows) if around else 0):
                for m in range(max(j - 1, 0), min(j + 2, cols)):
                    if numbers[k, m] > 0 and pressure[k, m] > best:
                        best = pressure[k, m]
                        owner[node] = numbers[k, m]
            if owner[node] > 0:
                pressing[owner[node] - 1] -= force[node, 2]
    return owner, pressing
