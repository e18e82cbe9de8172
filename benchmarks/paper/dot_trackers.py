"""Trackers of dots: each detects them in every frame, and gives them numbers in its own way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.split import check_image, to_grey
from cmp_tactile_processing.measured import Grid, GridFault, Status
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.tracking.detector import NominalGrid
from cmp_tactile_processing.tracking.image_fault import image_fault
from paper.chain import CMP, CMP_PAPER, Method
from paper.dots import DotDetector, DotImage, DotParameters, centroid_bias
from paper.grid_order import UNKNOWN, GridOrder, places

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Indices = NDArray[np.intp]

# What it costs, in squared gates, to leave a marker without a dot: more than any way to one.
LEFT_OUT = 10.0


def nearest_match(points: Array, last: Array, gate: Array) -> Indices:
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


def best_assignment(points: Array, last: Array, gate: Array) -> Indices:
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
    images: tuple[Image, Image], last: Array, side_px: float, parameters: DotParameters
) -> Array:
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

    Raises InputError for dots that are too small to be distinguished.
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
        self._rest: Array | None = None
        self.reset()

    def learn(self, at_rest: Sequence[Image]) -> None:
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
        self._last: Array | None = None
        self._last_image: DotImage | None = None

    def track(self, half_image: Image) -> Grid:
        """Dots of a view image, (H, W) grey or (H, W, 3) BGR uint8; their centres are the corners.

        Raises FrameError for an image of another size or type.
        """
        image = self._prepared(half_image)
        points = self._detector.detect(image)
        index = self._numbered(points, image)
        centres = places(points, index)
        self._remember(centres, image)
        corners = centres - self._bias(centres) + self._window.origin
        return self._grid(corners, index != UNKNOWN, image)

    def _numbered(self, points: Array, image: DotImage) -> Indices:
        raise NotImplementedError

    def _remember(self, centres: Array, image: DotImage) -> None:
        """Keep the last place of every marker, also of one that is lost now."""
        if self._last is None:
            self._last = self._start()
        self._last = np.where(np.isfinite(centres), centres, self._last)
        self._last_image = image

    def _start(self) -> Array:
        """Where markers are before the first frame: at rest as learnt, else by the description."""
        if self._rest is None:
            return self._nominal.corners
        return np.where(np.isfinite(self._rest), self._rest, self._nominal.corners)

    def _prepared(self, half_image: Image) -> DotImage:
        place = self._view.placement
        check_image(half_image, place.width, place.height, f"{self._view.name} view")
        part = to_grey(self._window.cut(half_image), self._weights)
        return self._detector.prepare(np.ascontiguousarray(part))

    def _by_grid(self, image: DotImage) -> Array:
        points = self._detector.detect(image)
        return places(points, self._order.number(points))

    def _bias(self, centres: Array) -> Array:
        """What perspective and curvature add to the centres, (rows, cols, 2) px."""
        radius = self._parameters.diameter / 2
        nominal = centroid_bias(self._nominal.corners, radius)
        if not self._parameters.curvature:
            return nominal
        measured = centroid_bias(centres, radius)
        return np.where(np.isfinite(measured), measured, nominal)

    def _grid(self, corners: Array, known: NDArray[np.bool_], image: DotImage) -> Grid:
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

    def _numbered(self, points: Array, image: DotImage) -> Indices:
        del image
        return self._order.number(points)


class NearestTracker(DotTracker):
    """Each dot is the marker with the nearest place in the last frame."""

    def _numbered(self, points: Array, image: DotImage) -> Indices:
        del image
        last = self._start() if self._last is None else self._last
        index = self._matched(points, last.reshape(-1, 2), self._order.side.ravel())
        return index.reshape(last.shape[:2])

    def _matched(self, points: Array, last: Array, side: Array) -> Indices:
        return nearest_match(points, last, self._parameters.nearest_gate * side)


class AssignmentTracker(NearestTracker):
    """All dots are matched to the last frame's at once, so that their ways are the shortest."""

    def _matched(self, points: Array, last: Array, side: Array) -> Indices:
        return best_assignment(points, last, self._parameters.assignment_gate * side)


class FlowTracker(DotTracker):
    """The flow takes markers from the last image near to their dots; lost ones are recovered where
    their neighbours expect them."""

    def _numbered(self, points: Array, image: DotImage) -> Indices:
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
