"""The separate contacts of a force field: their wrenches, areas, centres and outlines.

Contacts are hills of a map of pressure, parted by a watershed that keeps together what high passes
join.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from contourpy import FillType, LineType, SerialContourGenerator, ZInterp
from numba import njit
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.measured import Contact, SurfaceGrid

# Hills of pressure that touch are one contact where the pass between them reaches this share of
# the lower peak: what the limited resolution makes of a gap between two contacts is lower, what
# noise makes of one contact's pressure is higher.
MERGE_RATIO = 0.4
# Pressure on the outline over the contact's mean.  The reconstruction widens a contact, the more
# the narrower it is: the level is the first plus the second over the width squared, in spacings of
# the nodes.  Fitted to the areas of spheres from one to seven spacings in radius; where the
# pressure ends abruptly the outline stays too wide.  WIDTH_LEVEL: where the width is taken.
WIDE_LEVEL, NARROW_LEVEL, WIDTH_LEVEL = 0.25, 0.95, 0.3
# Even the outline of a single node encloses something.
HIGHEST_LEVEL = 0.6
# A hill is a contact where its normal force reaches this share of the strongest contact's, below
# which it may be an error of the reconstruction, and so many of its own standard deviations.
LEAST_SHARE, LEAST_DEVIATIONS = 0.01, 3.0

NO_OUTLINE = np.empty((0, 3))

Covariances = Callable[[NDArray[np.intp]], tuple[NDArray[np.float64], NDArray[np.float64]]]


@njit(cache=True, nogil=True, error_model="numpy")
def resultant_matrix(
    place: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(6, 3 n): force and moment about the origin of n nodal forces, each counted with a weight.

    place (n, 3): where they act, times the weight; weight (n,).
    """
    count = len(place)
    found: NDArray[np.float64] = np.zeros((6, 3 * count))
    for i in range(count):
        x, y, z = place[i]
        for component in range(3):
            found[component, 3 * i + component] = weight[i]
        found[3, 3 * i + 1], found[3, 3 * i + 2] = -z, y
        found[4, 3 * i], found[4, 3 * i + 2] = z, -x
        found[5, 3 * i], found[5, 3 * i + 1] = -y, x
    return found


def wrench_of(force: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Force and moment about the origin (6,) of nodal forces (n, 3) that act at `place` (n, 3)."""
    # The moment from the products' sums: numpy.cross takes longer than all the rest.
    product = place.T @ force
    moment = product.T[[2, 0, 1], [1, 2, 0]] - product.T[[1, 2, 0], [2, 0, 1]]
    return np.concatenate([force.sum(axis=0), moment])


@njit(cache=True, nogil=True, error_model="numpy")
def material_covariance(
    wrench: NDArray[np.float64],
    place: NDArray[np.float64],
    normal_std: float,
    tangential_std: float,
) -> NDArray[np.float64]:
    """Covariance (6, 6) of a wrench of not quite known normal and tangential scale.

    normal_std, tangential_std: relative.  The moments follow the forces that make them: those of
    the normal force about x and y, those of the tangential force at height place (3,) m as well.
    """
    force, moment = wrench[:3], wrench[3:]
    x, y, height = force[0], force[1], place[2]
    by_tangential = np.array([x, y, 0.0, -height * y, height * x, moment[2]])
    by_normal = wrench - by_tangential
    covariance: NDArray[np.float64] = normal_std**2 * np.outer(by_normal, by_normal)
    return covariance + tangential_std**2 * np.outer(by_tangential, by_tangential)


def basins(
    pressure: NDArray[np.float64], inside: NDArray[np.bool_], merge_ratio: float
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Number the hills of `pressure` (rows, cols) within the mask `inside` from 1; 0 is outside.

    Two hills that touch, sides or corners, are one where the highest pass between them reaches
    `merge_ratio` of the lower one's peak.  Returns the numbers (rows, cols) and, per hill, the
    lowest pass that joined its parts, inf where it is of one piece.
    """
    nodes = np.flatnonzero(inside)
    order = nodes[np.argsort(-pressure.ravel()[nodes], kind="stable")]
    number = np.zeros(pressure.size, dtype=np.intp)
    passes = np.full(len(order) + 1, np.inf)
    count = _flood(pressure.ravel(), order, pressure.shape[1], merge_ratio, number, passes)
    return number.reshape(pressure.shape), passes[1 : count + 1]


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def _root(parent: Any, hill: int) -> int:
    while parent[hill] != hill:
        hill = parent[hill]
    return hill


@njit(cache=True, nogil=True, error_model="numpy")
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


@dataclass(frozen=True)
class _Load:
    """What every contact of a frame is cut from.

    force, place (M, 3).  mask (M,): nodes in contact.  pressure (rows + 2, cols + 2): above 0 or
    0, with a frame of zeros around the grid.  owner (M,): the contact that a node belongs to.
    """

    force: NDArray[np.float64]
    place: NDArray[np.float64]
    mask: NDArray[np.bool_]
    pressure: NDArray[np.float64]
    owner: NDArray[np.intp]


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
        # The frame of zeros lies on the border itself, so that outlines are closed along it.
        row, col = (np.clip(np.arange(-1.0, n + 1), 0, n - 1) for n in (rows, cols))
        self._row, self._col = np.meshgrid(row, col, indexing="ij")
        border = np.ones(self._shape, dtype=bool)
        border[1:-1, 1:-1] = False
        self.border = border.ravel()
        # Compiled here, before the first frame.
        numbers, _ = basins(np.ones(self._shape), border, MERGE_RATIO)
        _with_neighbours(numbers, np.ones(self._shape), border)

    def contacts(
        self,
        force: NDArray[np.float64],
        contact: NDArray[np.bool_],
        place: NDArray[np.float64],
        covariances: Covariances,
    ) -> tuple[Contact, ...]:
        """Separate contacts, that of the largest normal force first.

        force (M, 3) N per node, on the gel; contact (M,): nodes in contact; place (M, 3) m: where
        the forces act, on the deformed surface; covariances: (6, 6) of the wrench of some nodes, of
        noise alone and what comes to it.  The first decides what is a contact.

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
        finite = np.isfinite(force).all(axis=1) & np.isfinite(place).all(axis=1)
        mask = np.asarray(contact, dtype=bool) & finite
        if not mask.any():
            return ()
        pressure = np.where(finite, -force[:, 2] / self._area, 0.0).reshape(self._shape)
        numbers, passes = basins(pressure, mask.reshape(self._shape), MERGE_RATIO)
        loaded = (finite & force.any(axis=1)).reshape(self._shape)
        owner = _with_neighbours(numbers, pressure, loaded).ravel()
        framed = np.zeros(self._row.shape)
        np.maximum(pressure, 0, out=framed[1:-1, 1:-1])
        load = _Load(force, place, mask, framed, owner)
        pressing = -np.bincount(owner[owner > 0], force[owner > 0, 2], minlength=len(passes) + 1)
        found = []
        for number in np.flatnonzero(pressing > LEAST_SHARE * max(pressing.max(), 0.0)):
            nodes = np.flatnonzero(owner == number)
            noise, more = covariances(nodes)
            if pressing[number] ** 2 < LEAST_DEVIATIONS**2 * noise[2, 2]:
                continue
            found.append(self._contact(load, nodes, noise + more, passes[number - 1]))
        return tuple(sorted(found, key=lambda item: item.wrench[2]))

    def _contact(
        self,
        load: _Load,
        nodes: NDArray[np.intp],
        covariance: NDArray[np.float64],
        lowest_pass: float,
    ) -> Contact:
        force, place = load.force[nodes], load.place[nodes]
        core = nodes[load.mask[nodes]]
        node_area = self._area[core]
        # On a sloping surface -f_z per area is not quite the pressure: it only sets the level.
        mean = -load.force[core, 2].sum() / node_area.sum()
        outline, cells = self._outline(load, nodes, mean, lowest_pass * (1 - 1e-9))
        weight = np.maximum(-force[:, 2], 0)
        total = weight.sum()
        return Contact(
            nodes=nodes,
            wrench=wrench_of(force, place),
            covariance=covariance,
            area=cells * float(node_area.mean()),
            centre_of_pressure=weight @ place / total if total > 0 else np.full(3, np.nan),
            outline=self._lift(outline, load.place),
            at_border=bool(self.border[core].any()),
        )

    def _outline(
        self, load: _Load, nodes: NDArray[np.intp], mean: float, highest: float
    ) -> tuple[NDArray[np.float64], float]:
        """Outer boundary (L, 2) of a contact and its area in cells; (col, row) of the nodes.

        mean: its mean pressure.  highest: level above which it would fall apart.
        """
        if not mean > 0:
            return np.empty((0, 2)), 0.0
        row, col = np.divmod(nodes, self._shape[1])
        # From one node before the first to one after the last, which the frame shifts by one.
        part = np.s_[row.min() : row.max() + 3, col.min() : col.max() + 3]
        height = np.zeros_like(load.pressure)
        height[row + 1, col + 1] = load.pressure[row + 1, col + 1]
        hill = _contours(self._col[part], self._row[part], height[part])
        rings = _rings_above(hill, min(WIDTH_LEVEL * mean, highest))
        # One over the radius of a disc, or over the width of a long strip.
        narrowness = sum(map(self._length, rings)) / (2 * sum(map(_signed_area, rings)))
        level = WIDE_LEVEL + NARROW_LEVEL * narrowness**2
        level = min(level * mean, highest, HIGHEST_LEVEL * height.max())
        rings = _rings_above(hill, level)
        outer = max(rings, key=_signed_area)
        # Closed: the last point is the first again; on the border of the grid others are, too.
        distinct = (outer[1:] != outer[:-1]).any(axis=1)
        return outer[1:][distinct], sum(map(_signed_area, rings))

    def _length(self, ring: NDArray[np.float64]) -> float:
        """Length of a closed ring in spacings; along the border of the grid it counts as open."""
        rows, cols = self._shape
        steps = np.hypot(*np.diff(ring, axis=0).T)
        along = np.zeros(len(steps), dtype=bool)
        for axis, last in ((0, cols - 1), (1, rows - 1)):
            for end in (0, last):
                on = ring[:, axis] == end
                along |= on[1:] & on[:-1]
        return float(steps[~along].sum())

    def _lift(
        self, outline: NDArray[np.float64], place: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Points (L, 2) as (col, row) on the deformed surface, (L, 3) m, linear between nodes."""
        if not len(outline):
            return NO_OUTLINE
        rows, cols = self._shape
        j = np.minimum(outline[:, 0].astype(np.intp), cols - 2)
        i = np.minimum(outline[:, 1].astype(np.intp), rows - 2)
        u, v = outline[:, :1] - j[:, None], outline[:, 1:] - i[:, None]
        first = i * cols + j
        lower = (1 - u) * place[first] + u * place[first + 1]
        upper = (1 - u) * place[first + cols] + u * place[first + cols + 1]
        return np.asarray((1 - v) * lower + v * upper)


@njit(cache=True, nogil=True, error_model="numpy")
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


def _contours(
    x: NDArray[np.float64], y: NDArray[np.float64], height: NDArray[np.float64]
) -> SerialContourGenerator:
    """What contour_generator makes of these, in a tenth of its time."""
    return SerialContourGenerator(
        x,
        y,
        height,
        np.zeros(height.shape, dtype=bool),
        corner_mask=False,
        line_type=LineType.Separate,
        fill_type=FillType.OuterOffset,
        quad_as_tri=False,
        z_interp=ZInterp.Linear,
    )


def _rings_above(hill: SerialContourGenerator, level: float) -> list[NDArray[np.float64]]:
    """Closed boundaries of what lies above a level: counter-clockwise, but holes clockwise."""
    return [
        points[first:end]
        for points, offsets in zip(*hill.filled(level, np.inf), strict=True)
        for first, end in pairwise(offsets)
    ]


def _signed_area(ring: NDArray[np.float64]) -> float:
    """Area (in units of the points) inside a closed ring, counter-clockwise positive."""
    x, y = (ring - ring[0]).T
    return float(x[:-1] @ y[1:] - x[1:] @ y[:-1]) / 2
