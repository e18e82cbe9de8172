"""Follows the dots of one view, as the trackers of the checkers follow their corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.split import check_image, to_grey
from cmp_tactile_processing.measured.grid import Grid, GridFault, Status
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.tracking.detector import NominalGrid
from cmp_tactile_processing.tracking.tracker import image_fault
from paper.dot_bias import centroid_bias
from paper.dot_detection import DotDetector, DotImage
from paper.dot_flow import flow
from paper.dot_grid import UNKNOWN, GridOrder, places
from paper.dot_nearest import best_assignment, nearest_match
from paper.dot_parameters import DotParameters

__all__ = ["AssignmentTracker", "DotTracker", "FlowTracker", "GridOrderTracker", "NearestTracker"]

# Standard deviation of a centre per coordinate, px: what pixels and shape leave, and what noise,
# as a share of the contrast, adds (results/paper_dot_tuning.md).
STD_PX, STD_PER_NOISE = 0.005, 0.52
# Where the flow loses more than this share of the dots, they are numbered anew.
LOST = 0.01


class DotTracker:
    """Dots of one view: detected anew in each frame, numbered as the subclass says.

    Raises GeometryError for dots that are too small to be told apart.
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
    """A dot is the marker whose place in the last frame is nearest."""

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
            anew = self._order.number(points)
            grid = anew if np.count_nonzero(anew == UNKNOWN) < lost else grid
        return grid
