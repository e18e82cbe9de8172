"""Numbers the dots of an image by the grid that they form, without an earlier image."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cmp_tactile_processing.tracking.detector import NominalGrid
from paper.dots import DotParameters

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# Index of a marker that no dot is.
UNKNOWN = -1
# Ways to a neighbour, (i, j).
STEPS = ((-1, 0), (0, 1), (1, 0), (0, -1))
# Steps of a point are the mean of those that the graph found within so many sides.
AROUND = 2.2
# Fewer dots do not show which part of the pattern they are, as a share of all.
LEAST_SHARE = 0.1
# A component of no more than one unseen border is anchored where its stillest quarter lies nearest
# to its nominal place, if nowhere else comes as near as this many times that.
STILL, NEARER = 0.25, 1.5
# A dot belongs to the grid where its neighbours across it leave it, within this share of the side.
STRAY = 0.35


class GridOrder:
    """Orders dots.  nominal: in the pixels of the dots."""

    def __init__(self, nominal: NominalGrid, parameters: DotParameters) -> None:
        self._nominal, self._parameters = nominal, parameters
        self._shape = nominal.corners.shape[:2]
        steps = nominal.row_step, nominal.col_step
        # Side px of the grid at each marker, (rows, cols), as it is at rest.
        self.side = np.minimum(*(np.linalg.norm(step, axis=-1) for step in steps))

    def number(self, points: Array) -> Indices:
        """Index (rows, cols) into points (N, 2) px of each marker, UNKNOWN where it is not seen."""
        index = np.full(self._shape, UNKNOWN, np.intp)
        if len(points) < LEAST_SHARE * index.size:
            return index
        components = _components(self._links(points))
        enough = LEAST_SHARE * index.size
        for members, labels in components:
            if len(members) < enough:
                break
            shift = self._anchor(points[members], labels)
            if shift is not None:
                self._place(index, members, labels + shift)
        if (index != UNKNOWN).any():
            self.drop_strays(points, index)
            self.fill(points, index)
            self.drop_strays(points, index)
        return index

    def fill(self, points: Array, index: Indices) -> None:
        """Give markers without a dot that one which lies where their neighbours expect it.

        The best founded first, so that what is found helps to find the next.
        """
        free = np.setdiff1d(np.arange(len(points)), index)
        if not len(free):
            return
        tree = cKDTree(points[free])
        gate = self._parameters.recovery_gate
        while len(free):
            place = _expected(places(points, index), self._nominal)
            number = np.argwhere((index == UNKNOWN) & np.isfinite(place[..., 0]))
            if not len(number):
                return
            distance, nearest = tree.query(place[tuple(number.T)])
            distance = distance / self.side[tuple(number.T)]
            best = int(np.argmin(distance))
            if not distance[best] < gate:
                return
            index[tuple(number[best])] = free[nearest[best]]
            free = np.delete(free, nearest[best])
            if len(free):
                tree = cKDTree(points[free])

    def drop_strays(self, points: Array, index: Indices) -> None:
        """Take away the numbers of dots that lie far from where their neighbours expect them."""
        for _ in range(index.size):
            place = places(points, index)
            off = np.linalg.norm(place - _expected(place, self._nominal), axis=-1)
            off = off / self.side
            if not np.nanmax(off, initial=0.0) > STRAY:
                return
            index[np.unravel_index(int(np.nanargmax(off)), self._shape)] = UNKNOWN

    def _links(self, points: Array) -> Indices:
        """Neighbours (N, 4) of each point by STEPS, UNKNOWN where none is: first by the nominal
        steps, then by those that were found around each point, which follow the deformation."""
        along_i, along_j = self._nominal.axes_near(points)
        tree = cKDTree(points)
        links = np.empty((len(points), 4), np.intp)
        for last in (False, True):
            links = _linked(points, tree, (along_i, along_j), self._parameters.grid_gate)
            if not last:
                radius = AROUND * self._nominal.side_px
                around = tree.query_ball_point(points, radius)
                along_i = _typical_step(points, links, (2, 0), (along_i, around))
                along_j = _typical_step(points, links, (1, 3), (along_j, around))
        return links

    def _anchor(self, points: Array, labels: Indices) -> Indices | None:
        """What takes its labels (N, 2) to markers' numbers; None where that is unclear."""
        low, high = labels.min(axis=0), labels.max(axis=0)
        room = np.array(self._shape) - (high - low + 1)
        if (room < 0).any():
            return self._anchor_of_most(labels)
        costs = {}
        for i in range(int(room[0]) + 1):
            for j in range(int(room[1]) + 1):
                number = labels - low + (i, j)
                nominal = self._nominal.corners[number[:, 0], number[:, 1]]
                away = np.linalg.norm(points - nominal, axis=1)
                costs[i, j] = float(np.quantile(away, STILL))
        ranked = sorted(costs, key=lambda shift: costs[shift])
        if len(ranked) > 1 and costs[ranked[1]] < NEARER * costs[ranked[0]]:
            return None
        return np.asarray(np.array(ranked[0]) - low)

    def _anchor_of_most(self, labels: Indices) -> Indices | None:
        """Of a component with strays beyond the pattern: where the fewest are left out."""
        low, high = labels.min(axis=0), labels.max(axis=0)
        best, most = None, 0.8 * len(labels)
        for i in range(int(low[0]), int(high[0]) + 1):
            for j in range(int(low[1]), int(high[1]) + 1):
                number = labels - (i, j)
                inside = ((number >= 0) & (number < self._shape)).all(axis=1)
                if inside.sum() > most:
                    best, most = np.array((-i, -j)), float(inside.sum())
        return best

    def _place(self, index: Indices, members: Indices, number: Indices) -> None:
        inside = ((number >= 0) & (number < self._shape)).all(axis=1)
        i, j = number[inside].T
        empty = index[i, j] == UNKNOWN
        index[i[empty], j[empty]] = members[inside][empty]


def _linked(points: Array, tree: cKDTree, steps: tuple[Array, Array], gate: float) -> Indices:
    """Neighbours (N, 4) that take each other for neighbours."""
    links = np.full((len(points), 4), UNKNOWN, np.intp)
    for way, (di, dj) in enumerate(STEPS):
        step = di * steps[0] + dj * steps[1]
        distance, nearest = tree.query(points + step)
        near = distance < gate * np.linalg.norm(step, axis=1)
        links[near, way] = nearest[near]
    numbers = np.arange(len(points))
    for way in range(4):
        there = links[:, way]
        back = np.where(there != UNKNOWN, links[there, (way + 2) % 4], UNKNOWN)
        links[:, way] = np.where((there != UNKNOWN) & (back == numbers), there, UNKNOWN)
    return links


def _typical_step(
    points: Array, links: Indices, ways: tuple[int, int], known: tuple[Array, list[list[int]]]
) -> Array:
    """Median step (N, 2) along one axis of the points around each; the known one where none is."""
    before, around = known
    ahead = links[:, ways[0]]
    step = np.where((ahead != UNKNOWN)[:, None], points[ahead] - points, np.nan)
    result = before.copy()
    for n, members in enumerate(around):
        steps = step[members]
        steps = steps[np.isfinite(steps[:, 0])]
        if len(steps) >= 3:
            result[n] = np.median(steps, axis=0)
    return np.asarray(result)


def _components(links: Indices) -> list[tuple[Indices, Indices]]:
    """Connected points with their labels (i, j), the largest first.

    Points with most neighbours are labelled first; a label is given once, and one that does not
    agree with a neighbour's leaves the point out.
    """
    degree = (links != UNKNOWN).sum(axis=1)
    label: dict[int, tuple[int, int]] = {}
    components = []
    for seed in np.argsort(-degree, kind="stable"):
        if int(seed) in label or degree[seed] == 0:
            continue
        members = _grown(int(seed), links, degree, label)
        components.append((np.array(members), np.array([label[n] for n in members])))
    return sorted(components, key=lambda component: -len(component[0]))


def _grown(
    seed: int, links: Indices, degree: Indices, label: dict[int, tuple[int, int]]
) -> list[int]:
    taken = {(0, 0)}
    label[seed] = (0, 0)
    members, queue = [seed], [(-int(degree[seed]), seed)]
    while queue:
        _, n = heapq.heappop(queue)
        for way, (di, dj) in enumerate(STEPS):
            other = int(links[n, way])
            place = label[n][0] + di, label[n][1] + dj
            if other == UNKNOWN or other in label or place in taken:
                continue
            label[other] = place
            taken.add(place)
            members.append(other)
            heapq.heappush(queue, (-int(degree[other]), other))
    return members


def places(points: Array, index: Indices) -> Array:
    """Position (rows, cols, 2) of each marker by index (rows, cols), NaN where it has no dot."""
    found = np.full((*index.shape, 2), np.nan)
    known = index != UNKNOWN
    found[known] = points[index[known]]
    return found


def _expected(places: Array, nominal: NominalGrid) -> Array:
    """Where neighbours expect each marker, (rows, cols, 2): their displacement carried over.

    The median of what each pair of neighbours - opposite, or one behind the other - expects, of at
    least two; NaN where fewer are known.
    """
    moved = places - nominal.corners
    padded = np.pad(moved, ((2, 2), (2, 2), (0, 0)), constant_values=np.nan)
    rows, cols = moved.shape[:2]

    def at(di: int, dj: int) -> Array:
        return padded[2 + di : 2 + di + rows, 2 + dj : 2 + dj + cols]

    data = [(at(1, 0) + at(-1, 0)) / 2, (at(0, 1) + at(0, -1)) / 2]
    data += [2 * at(di, dj) - at(2 * di, 2 * dj) for di, dj in STEPS]
    data += [at(di, 0) + at(0, dj) - at(di, dj) for di in (-1, 1) for dj in (-1, 1)]
    stack = np.array(data)
    enough = np.isfinite(stack[..., 0]).sum(axis=0) >= 2
    stack[:, ~enough] = np.inf
    middle = np.nanmedian(stack, axis=0)
    return np.where(enough[..., None], nominal.corners + middle, np.nan)
