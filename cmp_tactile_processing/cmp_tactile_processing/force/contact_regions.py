"""The separate contacts of a force field: their wrenches, areas, centres and outlines.

Contacts are hills of a map of pressure, parted by a watershed that keeps together what high passes
join.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.force.outline import outline
from cmp_tactile_processing.measured import Contact, SurfaceGrid

# Hills of pressure that touch are one contact where the pass between them reaches this share of
# the lower peak: what the limited resolution makes of a gap between two contacts is lower, what
# noise makes of one contact's pressure is higher.
MERGE_RATIO = 0.4
# A hill is a contact where its normal force reaches this share of the strongest contact's, below
# which it may be an error of the reconstruction, and so many of its own standard deviations.
LEAST_SHARE, LEAST_DEVIATIONS = 0.01, 3.0

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Numbers = NDArray[np.intp]
# Of the wrenches of some sets of nodes, for each by noise alone and what comes to it.
Covariances = Callable[[list[Numbers]], list[tuple[Array, Array]]]


def resultant_matrix(place: Array, weight: Array) -> Array:
    """(6, 3 n): force and moment about the origin of n nodal forces, each counted with a weight.

    place (n, 3): where they act, times the weight; weight (n,).
    """
    found = np.zeros((6, len(place), 3))
    x, y, z = place.T
    for axis in range(3):
        found[axis, :, axis] = weight
    found[3, :, 1], found[3, :, 2] = -z, y
    found[4, :, 0], found[4, :, 2] = z, -x
    found[5, :, 0], found[5, :, 1] = -y, x
    return found.reshape(6, -1)


def wrench_of(force: Array, place: Array) -> Array:
    """Force and moment about the origin (6,) of nodal forces (n, 3) that act at `place` (n, 3)."""
    arms = place.T @ force
    moment = arms[1, 2] - arms[2, 1], arms[2, 0] - arms[0, 2], arms[0, 1] - arms[1, 0]
    return np.array([*force.sum(axis=0), *moment])


def material_covariance(
    wrench: Array, place: Array, normal_std: float, tangential_std: float
) -> Array:
    """Covariance (6, 6) of a wrench of not quite known normal and tangential scale.

    normal_std, tangential_std: relative.  The moments follow the forces that make them: those of
    the normal force about x and y, those of the tangential force at height place (3,) m as well.
    """
    x, y, height = wrench[0], wrench[1], place[2]
    by_tangential = np.array([x, y, 0.0, -height * y, height * x, wrench[5]])
    by_normal = wrench - by_tangential
    covariance = normal_std**2 * np.outer(by_normal, by_normal)
    return np.asarray(covariance + tangential_std**2 * np.outer(by_tangential, by_tangential))


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


class _Load(NamedTuple):
    """What every contact of a frame is cut from.

    force, place (M, 3).  mask (M,): nodes in contact.  pressure (rows, cols).  owner (M,): the hill
    that a node belongs to, from 1.  pressing (hills + 1,) N: its normal force.  passes (hills,).
    """

    force: NDArray[np.float64]
    place: NDArray[np.float64]
    mask: NDArray[np.bool_]
    pressure: NDArray[np.float64]
    owner: NDArray[np.intp]
    pressing: NDArray[np.float64]
    passes: NDArray[np.float64]


class _Shape(NamedTuple):
    """What a Contact says of its own, besides how well it is known."""

    area: float
    centre_of_pressure: NDArray[np.float64]
    outline: NDArray[np.float64]
    at_border: bool


class ContactRegions:
    """Finds the separate contacts on a grid of force nodes.

    nodes: the grid.  node_area (M,) m^2: undeformed contact surface that belongs to each node.
    border (M,): the outermost nodes.  Raises GeometryError where the two do not belong together.
    """

    def __init__(self, nodes: SurfaceGrid, node_area: NDArray[np.float64]) -> None:
        rows, cols = self._shape = nodes.rows, nodes.cols
        self._area = np.asarray(node_area, dtype=np.float64)
        if self._area.shape != (rows * cols,):
            msg = f"node_area: found shape {self._area.shape}, expected {(rows * cols,)}"
            raise GeometryError(msg)
        border = np.ones(self._shape, dtype=bool)
        border[1:-1, 1:-1] = False
        self.border = border.ravel()
        # Compiled here, before the first frame.
        one, nothing = np.zeros((rows * cols, 3)), (np.zeros((6, 6)), np.zeros((6, 6)))
        one[0, 2] = -1.0
        self.contacts(one, one[:, 2] < 0, np.zeros(one.shape), lambda sets: [nothing] * len(sets))

    def contacts(
        self,
        force: NDArray[np.float64],
        contact: NDArray[np.bool_],
        place: NDArray[np.float64],
        covariances: Covariances,
    ) -> tuple[Contact, ...]:
        """Separate contacts, that of the largest normal force first.

        force (M, 3) N per node, on the gel; contact (M,): nodes in contact; place (M, 3) m: where
        the forces act, on the deformed surface; covariances: for each of
        some sets of nodes (6, 6) of its wrench, of noise alone and what comes to it.  The first
        decides what is a contact.

        A contact is a hill of pressure: nodes of the mask that touch, sides or corners, but for
        hills that a deep pass parts.  To its nodes belong those next to the mask that bear the
        rest of its force, so that the contacts' wrenches add up to that of all nodes.  Nodes
        without a finite force belong to none; a hill with a normal force that does not stand out of
        its noise, or is below 1 % of the strongest contact's, is none.

        The outline follows a level of the normal pressure between the nodes, closed along the
        border of the grid where the contact goes on beyond it.  Of a ring it is the outer edge;
        its hole is left out of the area, as the area is what lies above that level.
        Under spheres from one to seven spacings of the nodes in radius, reconstructed from noisy
        markers, the area is right within 10 % and the outline within 0.1 to 0.3 spacings.  Where
        the pressure ends abruptly (a flat punch, a ring, an edge) the reconstruction rounds it
        off: the outline lies 0.3 to 0.7 spacings too far out, the area is a fifth to a half too
        large.  Two contacts are found apart when their edges are 0.7 spacings from each other.
        """
        mask = np.asarray(contact, dtype=bool)
        if not mask.any():
            return ()
        load = _load(force, place, mask, self._area, self._shape)
        least = LEAST_SHARE * max(load.pressing.max(), 0.0)
        numbers = np.flatnonzero(load.pressing > least)
        found, owned = [], [np.flatnonzero(load.owner == number) for number in numbers]
        for number, nodes, (noise, more) in zip(numbers, owned, covariances(owned), strict=True):
            if load.pressing[number] ** 2 < LEAST_DEVIATIONS**2 * noise[2, 2]:
                continue
            shape = _shape(load, nodes, self._area, self.border)
            found.append(
                Contact(nodes, wrench_of(force[nodes], place[nodes]), noise + more, *shape)
            )
        return tuple(sorted(found, key=lambda item: item.wrench[2]))


def _load(force: Array, place: Array, contact: Mask, area: Array, shape: tuple[int, int]) -> _Load:
    """The hills of a frame; area (M,): of the nodes."""
    known = np.isfinite(force).all(axis=1) & np.isfinite(place).all(axis=1)
    mask, loaded = known & contact, known & force.any(axis=1)
    grid = np.where(known, -force[:, 2] / area, 0.0).reshape(shape)
    numbers, passes = basins(grid, mask.reshape(shape), MERGE_RATIO)
    owner = _with_neighbours(numbers, grid, loaded.reshape(shape)).reshape(-1)
    normal = np.where(owner > 0, -force[:, 2], 0.0)
    pressing = np.asarray(np.bincount(owner, normal, len(passes) + 1), np.float64)
    return _Load(force, place, mask, grid, owner, pressing, passes)


def _shape(load: _Load, nodes: Numbers, area: Array, border: Mask) -> _Shape:
    """One contact, by its nodes."""
    rows, cols = load.pressure.shape
    force, place, core = load.force[nodes], load.place[nodes], load.mask[nodes]
    pressing = np.maximum(-force[:, 2], 0.0)
    total = float(pressing.sum())
    centre = pressing @ place / total if total > 0 else np.full(3, np.nan)
    height = np.zeros((rows + 2, cols + 2))
    at = nodes // cols, nodes % cols
    height[at[0] + 1, at[1] + 1] = np.maximum(load.pressure[at], 0.0)
    core_area = float(area[nodes][core].sum())
    # On a sloping surface -f_z per area is not quite the pressure: it only sets the level.
    level = float(-force[core, 2].sum()) / core_area
    highest = load.passes[load.owner[nodes[0]] - 1] * (1 - 1e-9)
    points, cells = outline(height, level, highest)
    points = _lifted(points, load.place, (rows, cols))
    at_border = bool(border[nodes][core].any())
    return _Shape(cells * core_area / np.count_nonzero(core), centre, points, at_border)


def _lifted(points: Array, place: Array, shape: tuple[int, int]) -> Array:
    """Points (L, 2) as (col, row) on the deformed surface, (L, 3) m, linear between nodes."""
    last = np.array([shape[1] - 2, shape[0] - 2])
    corner = np.minimum(points.astype(np.intp), last)
    first, (u, v) = corner[:, 1] * shape[1] + corner[:, 0], (points - corner).T[..., None]
    lower = (1 - u) * place[first] + u * place[first + 1]
    upper = (1 - u) * place[first + shape[1]] + u * place[first + shape[1] + 1]
    return np.asarray((1 - v) * lower + v * upper)


@kernel
def _with_neighbours(
    numbers: NDArray[np.intp], pressure: NDArray[np.float64], loaded: NDArray[np.bool_]
) -> NDArray[np.intp]:
    """Numbers of the contacts, given also to loaded nodes beside them: that of the highest one."""
    rows, cols = numbers.shape
    owner: NDArray[np.intp] = numbers.copy()
    for i in range(rows):
        for j in range(cols):
            if numbers[i, j] != 0 or not loaded[i, j]:
                continue
            best = -np.inf
            for k in range(max(i - 1, 0), min(i + 2, rows)):
                for m in range(max(j - 1, 0), min(j + 2, cols)):
                    if numbers[k, m] > 0 and pressure[k, m] > best:
                        best = pressure[k, m]
                        owner[i, j] = numbers[k, m]
    return owner
