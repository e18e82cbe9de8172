"""Numbers the dots of an image by the grid that they form, without an earlier image."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.split import check_image, to_grey
from cmp_tactile_processing.measured import Grid, GridFault, Status
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.tracking.detector import NominalGrid
from cmp_tactile_processing.tracking.tracker import image_fault
from paper.chain import CMP, CMP_PAPER, Method
from paper.dots import DotDetector, DotImage, DotParameters, centroid_bias

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

    def number(self, points: NDArray[np.float64]) -> NDArray[np.intp]:
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

    def fill(self, points: NDArray[np.float64], index: NDArray[np.intp]) -> None:
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
            distance = distance / self._side(number)
            best = int(np.argmin(distance))
            if not distance[best] < gate:
                return
            index[tuple(number[best])] = free[nearest[best]]
            free = np.delete(free, nearest[best])
            if len(free):
                tree = cKDTree(points[free])

    def drop_strays(self, points: NDArray[np.float64], index: NDArray[np.intp]) -> None:
        """Take away the numbers of dots that lie far from where their neighbours expect them."""
        for _ in range(index.size):
            place = places(points, index)
            off = np.linalg.norm(place - _expected(place, self._nominal), axis=-1)
            number = np.indices(self._shape)
            off = off / self._side(np.moveaxis(number, 0, -1).reshape(-1, 2)).reshape(self._shape)
            if not np.nanmax(off, initial=0.0) > STRAY:
                return
            index[np.unravel_index(int(np.nanargmax(off)), self._shape)] = UNKNOWN

    def _side(self, number: NDArray[np.intp]) -> NDArray[np.float64]:
        """Side px of the grid at markers (N, 2), as it is at rest."""
        i, j = number.T
        steps = self._nominal.row_step[i, j], self._nominal.col_step[i, j]
        return np.asarray(np.minimum(*(np.linalg.norm(step, axis=-1) for step in steps)))

    def _links(self, points: NDArray[np.float64]) -> NDArray[np.intp]:
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

    def _anchor(
        self, points: NDArray[np.float64], labels: NDArray[np.intp]
    ) -> NDArray[np.intp] | None:
        """What takes its labels (N, 2) to markers' numbers; None where that is unclear."""
        low, high = labels.min(axis=0), labels.max(axis=0)
        room = np.array(self._shape) - (high - low + 1)
        if (room < 0).any():
            return self._anchor_of_most(points, labels)
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

    def _anchor_of_most(
        self, points: NDArray[np.float64], labels: NDArray[np.intp]
    ) -> NDArray[np.intp] | None:
        """Of a component with strays beyond the pattern: where the fewest are left out."""
        low, high = labels.min(axis=0), labels.max(axis=0)
        best, most = None, 0.8 * len(labels)
        for i in range(int(low[0]), int(high[0]) + 1):
            for j in range(int(low[1]), int(high[1]) + 1):
                number = labels - (i, j)
                inside = ((number >= 0) & (number < self._shape)).all(axis=1)
                if inside.sum() > most:
                    best, most = np.array((-i, -j)), float(inside.sum())
        del points
        return best

    def _place(
        self, index: NDArray[np.intp], members: NDArray[np.intp], number: NDArray[np.intp]
    ) -> None:
        inside = ((number >= 0) & (number < self._shape)).all(axis=1)
        i, j = number[inside].T
        empty = index[i, j] == UNKNOWN
        index[i[empty], j[empty]] = members[inside][empty]


def _linked(
    points: NDArray[np.float64],
    tree: cKDTree,
    steps: tuple[NDArray[np.float64], NDArray[np.float64]],
    gate: float,
) -> NDArray[np.intp]:
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
    points: NDArray[np.float64],
    links: NDArray[np.intp],
    ways: tuple[int, int],
    known: tuple[NDArray[np.float64], list[list[int]]],
) -> NDArray[np.float64]:
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


def _components(links: NDArray[np.intp]) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
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
    seed: int, links: NDArray[np.intp], degree: NDArray[np.intp], label: dict[int, tuple[int, int]]
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


def places(points: NDArray[np.float64], index: NDArray[np.intp]) -> NDArray[np.float64]:
    """Position (rows, cols, 2) of each marker by index (rows, cols), NaN where it has no dot."""
    found = np.full((*index.shape, 2), np.nan)
    known = index != UNKNOWN
    found[known] = points[index[known]]
    return found


def _expected(places: NDArray[np.float64], nominal: NominalGrid) -> NDArray[np.float64]:
    """Where neighbours expect each marker, (rows, cols, 2): their displacement carried over.

    The median of what each pair of neighbours - opposite, or one behind the other - expects, of at
    least two; NaN where fewer are known.
    """
    moved = places - nominal.corners
    padded = np.pad(moved, ((2, 2), (2, 2), (0, 0)), constant_values=np.nan)
    rows, cols = moved.shape[:2]

    def at(di: int, dj: int) -> NDArray[np.float64]:
        return padded[2 + di : 2 + di + rows, 2 + dj : 2 + dj + cols]

    data = [(at(1, 0) + at(-1, 0)) / 2, (at(0, 1) + at(0, -1)) / 2]
    data += [2 * at(di, dj) - at(2 * di, 2 * dj) for di, dj in STEPS]
    data += [at(di, 0) + at(0, dj) - at(di, dj) for di in (-1, 1) for dj in (-1, 1)]
    stack = np.array(data)
    enough = np.isfinite(stack[..., 0]).sum(axis=0) >= 2
    stack[:, ~enough] = np.inf
    middle = np.nanmedian(stack, axis=0)
    return np.where(enough[..., None], nominal.corners + middle, np.nan)


# What it costs, in squared gates, to leave a marker without a dot: more than any way to one.
LEFT_OUT = 10.0


def nearest_match(
    points: NDArray[np.float64], last: NDArray[np.float64], gate: NDArray[np.float64]
) -> NDArray[np.intp]:
    """Index (M,) into points (N, 2) px of each marker, UNKNOWN where none is near enough.

    last (M, 2) px: where the markers were; gate (M,) px.  One to one: of all pairs that are left
    the closest is taken, again and again.
    """
    index = np.full(len(last), UNKNOWN, np.intp)
    if not len(points):
        return index
    way = cdist(last, points)
    markers, dots = np.nonzero(way < gate[:, None])
    free = np.ones(len(points), np.bool_)
    for k in np.argsort(way[markers, dots], kind="stable"):
        if index[markers[k]] == UNKNOWN and free[dots[k]]:
            index[markers[k]] = dots[k]
            free[dots[k]] = False
    return index


def best_assignment(
    points: NDArray[np.float64], last: NDArray[np.float64], gate: NDArray[np.float64]
) -> NDArray[np.intp]:
    """As `nearest_match`, but as many markers as possible find a dot, and the sum of the squared
    ways of all of them is the least."""
    index = np.full(len(last), UNKNOWN, np.intp)
    if not len(points):
        return index
    way = cdist(last, points) / gate[:, None]
    markers, dots = linear_sum_assignment(np.where(way < 1, way**2, LEFT_OUT))
    near = way[markers, dots] < 1
    index[markers[near]] = dots[near]
    return index


def flow(
    images: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    last: NDArray[np.float64],
    side_px: float,
    parameters: DotParameters,
) -> NDArray[np.float64]:
    """Where markers (M, 2) px of the first image are in the second; NaN where that is in doubt.

    images (H, W) grey.  In doubt is what the flow back does not take to where it came from.
    """
    size = max(round(parameters.flow_window * side_px), 5) | 1
    moved = partial(
        cv2.calcOpticalFlowPyrLK,
        winSize=(size, size),
        maxLevel=parameters.flow_levels,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01),
    )
    before, now = images
    start = np.ascontiguousarray(last, dtype=np.float32).reshape(-1, 1, 2)
    end, found, _ = moved(before, now, start, np.empty_like(start))
    back, returned, _ = moved(now, before, end, np.empty_like(start))
    miss = np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    sure = (found.ravel() == 1) & (returned.ravel() == 1) & (miss < parameters.flow_return)
    return np.where(sure[:, None], end.reshape(-1, 2).astype(np.float64), np.nan)


# Standard deviation of a centre per coordinate, px: what pixels and shape leave, and what noise,
# as a share of the contrast, adds (results/paper_dot_tuning.md).
STD_PX, STD_PER_NOISE = 0.005, 0.52
# Where the flow loses more than this share of the dots, they are numbered again.
LOST = 0.01


class DotTracker:
    """Dots of one view: detected again in each frame, numbered as the subclass says.

    Raises GeometryError for dots that are too small to be distinguished.
    """

    def __init__(
        self, sensor: SensorDescription, view: str, parameters: DotParameters | None = None
    ) -> None:
        self._parameters = parameters or DotParameters()
        self._view = build_views(sensor)[view]
        self._pattern, self._weights = sensor.pattern, sensor.tracking.grey_weights
        full = NominalGrid.of_view(sensor.pattern, self._view)
        place = self._view.placement
        self._window = full.window(place.width, place.height)
        self._nominal = full.seen_through(self._window)
        shape = self._window.height, self._window.width
        self._detector = DotDetector(self._nominal, shape, self._parameters)
        self._order = GridOrder(self._nominal, self._parameters)
        self._rest: NDArray[np.float64] | None = None
        self.reset()

    def learn(self, at_rest: Sequence[NDArray[np.uint8]]) -> None:
        """Number the dots of the gel at rest by the grid that they form."""
        found = [self._by_grid(self._prepared(image)) for image in at_rest]
        if found:
            stack = np.array(found)
            known = np.asarray(np.isfinite(stack[..., 0]).any(axis=0))
            stack[:, ~known] = 0.0
            self._rest = np.where(known[..., None], np.nanmean(stack, axis=0), np.nan)
        self.reset()

    def reset(self) -> None:
        """Forget earlier frames; what was learnt is kept."""
        self._last: NDArray[np.float64] | None = None
        self._last_image: DotImage | None = None

    def track(self, half_image: NDArray[np.uint8]) -> Grid:
        """Dots of a view image, (H, W) grey or (H, W, 3) BGR uint8; their centres are the corners.

        Raises FrameError for an image of another size or type.
        """
        image = self._prepared(half_image)
        dots = self._detector.detect(image)
        index = self._numbered(dots.position, image)
        centres = places(dots.position, index)
        self._remember(centres, image)
        corners = centres - self._bias(centres) + self._window.origin
        return self._grid(corners, index != UNKNOWN, image)

    def _numbered(self, points: NDArray[np.float64], image: DotImage) -> NDArray[np.intp]:
        raise NotImplementedError

    def _remember(self, centres: NDArray[np.float64], image: DotImage) -> None:
        """Keep the last place of every marker, also of one that is lost now."""
        if self._last is None:
            self._last = self._start()
        self._last = np.where(np.isfinite(centres), centres, self._last)
        self._last_image = image

    def _start(self) -> NDArray[np.float64]:
        """Where markers are before the first frame: at rest as learnt, else by the description."""
        if self._rest is None:
            return self._nominal.corners
        return np.where(np.isfinite(self._rest), self._rest, self._nominal.corners)

    def _prepared(self, half_image: NDArray[np.uint8]) -> DotImage:
        place = self._view.placement
        check_image(half_image, place.width, place.height, f"{self._view.name} view")
        part = to_grey(self._window.cut(half_image), self._weights)
        return self._detector.prepare(np.ascontiguousarray(part))

    def _by_grid(self, image: DotImage) -> NDArray[np.float64]:
        points = self._detector.detect(image).position
        return places(points, self._order.number(points))

    def _bias(self, centres: NDArray[np.float64]) -> NDArray[np.float64]:
        """What perspective and curvature add to the centres, (rows, cols, 2) px."""
        radius = self._parameters.diameter / 2
        nominal = centroid_bias(self._nominal.corners, radius)
        if not self._parameters.curvature:
            return nominal
        measured = centroid_bias(centres, radius)
        return np.where(np.isfinite(measured), measured, nominal)

    def _grid(
        self, corners: NDArray[np.float64], known: NDArray[np.bool_], image: DotImage
    ) -> Grid:
        shape, place = self._pattern.shape, self._view.placement
        missing = int(known.size - known.sum())
        if missing == known.size:
            fault, reason = image_fault(image.grey)
            fault = fault or GridFault.NO_PATTERN
            return Grid.missing(shape, reason or "no dots numbered", place, fault)
        std = float(np.hypot(STD_PX, STD_PER_NOISE * image.noise))
        return replace(
            Grid.missing(shape, f"{missing} dots not seen" if missing else "", place),
            corners=corners,
            corner_status=np.where(known, Status.MEASURED, Status.MISSING).astype(np.uint8),
            fault=GridFault.PARTLY_HIDDEN if missing else GridFault.NONE,
            corner_std=np.where(known, std, np.nan),
            confidence=1 - missing / known.size,
        )


class GridOrderTracker(DotTracker):
    """Numbers by the grid that the dots form, each frame by itself."""

    def _numbered(
        self,
        points: NDArray[np.float64],
        image: DotImage,  # noqa: ARG002
    ) -> NDArray[np.intp]:
        return self._order.number(points)


class NearestTracker(DotTracker):
    """Each dot is the marker with the nearest place in the last frame."""

    def _numbered(
        self,
        points: NDArray[np.float64],
        image: DotImage,  # noqa: ARG002
    ) -> NDArray[np.intp]:
        last = self._start() if self._last is None else self._last
        side = np.minimum(
            *(np.linalg.norm(s, axis=-1) for s in (self._nominal.row_step, self._nominal.col_step))
        )
        index = self._matched(points, last.reshape(-1, 2), side.ravel())
        return index.reshape(last.shape[:2])

    def _matched(
        self, points: NDArray[np.float64], last: NDArray[np.float64], side: NDArray[np.float64]
    ) -> NDArray[np.intp]:
        return nearest_match(points, last, self._parameters.nearest_gate * side)


class AssignmentTracker(NearestTracker):
    """All dots are matched to the last frame's at once, so that their ways are the shortest."""

    def _matched(
        self, points: NDArray[np.float64], last: NDArray[np.float64], side: NDArray[np.float64]
    ) -> NDArray[np.intp]:
        return best_assignment(points, last, self._parameters.assignment_gate * side)


class FlowTracker(DotTracker):
    """The flow takes markers from the last image near to their dots; lost ones are recovered where
    their neighbours expect them."""

    def _numbered(self, points: NDArray[np.float64], image: DotImage) -> NDArray[np.intp]:
        if self._last is None or self._last_image is None:
            return self._order.number(points)
        side = self._nominal.side_px
        images = self._last_image.grey, image.grey
        moved = flow(images, self._last.reshape(-1, 2), side, self._parameters)
        sure = np.isfinite(moved[:, 0])
        index = np.full(len(moved), UNKNOWN, np.intp)
        gate = np.full(int(sure.sum()), self._parameters.recovery_gate * side)
        index[sure] = nearest_match(points, moved[sure], gate)
        grid = index.reshape(self._last.shape[:2])
        if (grid != UNKNOWN).any():
            self._order.drop_strays(points, grid)
            self._order.fill(points, grid)
        lost = np.count_nonzero(grid == UNKNOWN)
        if lost > LOST * grid.size:
            fresh = self._order.number(points)
            grid = fresh if np.count_nonzero(fresh == UNKNOWN) < lost else grid
        return grid


DMP_NEAREST = Method("dmp_nearest", "DMP, nearest dot", "dmp", NearestTracker)
# Beyond II.A: all dots at once instead of the nearest one for each.
DMP_ASSIGNMENT = Method("dmp_assignment", "DMP, best assignment", "dmp", AssignmentTracker)
DMP_GRID = Method("dmp_grid", "DMP, grid order", "dmp", GridOrderTracker)
DMP_FLOW = Method("dmp_flow", "DMP, optical flow", "dmp", FlowTracker)
ALL_METHODS = (CMP, CMP_PAPER, DMP_NEAREST, DMP_GRID, DMP_FLOW)
# Where the numbering is what is judged.
FOLLOWING_METHODS = (CMP, CMP_PAPER, DMP_NEAREST, DMP_ASSIGNMENT, DMP_GRID, DMP_FLOW)
