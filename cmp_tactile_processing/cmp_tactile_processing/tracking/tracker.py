"""The tracking stage: one view image in, its numbered gridlines out."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.split import check_image, to_grey
from cmp_tactile_processing.image.prefilter import Prefilter
from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.measured.grid import Grid, GridFault, Status
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parameters import TrackingParameters
from cmp_tactile_processing.sensor.pattern import Pattern
from cmp_tactile_processing.tracking.contour_stitching.stitcher import ContourStitching
from cmp_tactile_processing.tracking.corners.measured_markers import (
    MeasuredCorners,
    MeasuredMarkers,
)
from cmp_tactile_processing.tracking.corners.saddle_lattice import SaddleLattice
from cmp_tactile_processing.tracking.detector import GridlineDetector
from cmp_tactile_processing.tracking.gridline_curves import curve_residual
from cmp_tactile_processing.tracking.image_fault import image_fault
from cmp_tactile_processing.tracking.nominal_grid import NominalGrid
from cmp_tactile_processing.tracking.nominal_picture import draw_nominal, spoilt_pictures
from cmp_tactile_processing.tracking.numbering.torn_frame import torn_rows
from cmp_tactile_processing.tracking.numbering.whole_view import (
    GridNumbering,
    Numbering,
    without_strays,
)
from cmp_tactile_processing.tracking.print_inspection.defects import PrintDefects
from cmp_tactile_processing.tracking.print_inspection.inspector import PrintInspection
from cmp_tactile_processing.tracking.virtual_markers.locator import VirtualMarkerLocator

__all__ = ["GridTracker"]

# From frame to frame the way to a neighbour changes by less than this share of a checker's side;
# where it changes by more, a corner has been taken for another one.
LARGEST_CHANGE = 0.3
# A corner of less weight is destroyed by a flaw of the print: it is where its surroundings have it.
LEAST_WEIGHT = 0.05

# What this process has compiled or loaded everything for: the other view of a sensor, or another
# tracker of it, is there at once.
_warm: set[tuple[Pattern, TrackingParameters]] = set()


class GridTracker:
    """Finds the gridlines of one view, and follows them from frame to frame.

    A complete grid is looked for where the last frame had it.  Everything is checked again in the
    image - each corner's colours, its edges to the neighbours, the pattern's border - and where
    anything is in doubt the grid is detected anew from this image alone.
    Raises GeometryError for a view that the sensor does not have.
    """

    def __init__(self, sensor: SensorDescription, view: str = "left") -> None:
        views = build_views(sensor)
        if view not in views:
            msg = f"{sensor.name}: found no view '{view}', expected one of {', '.join(views)}"
            raise GeometryError(msg)
        self._view = views[view]
        self._pattern, self._parameters = sensor.pattern, sensor.tracking
        full = NominalGrid.of_view(sensor.pattern, self._view)
        place = self._view.placement
        self._window = full.window(place.width, place.height)
        self._nominal = full.seen_through(self._window)
        self._grey = np.empty((self._window.height, self._window.width), dtype=np.uint8)
        dark_first = sensor.pattern.corner_checker == "dark"
        self._prefilter = Prefilter(self._grey.shape, self._nominal.side_px)
        self._detector = self._chosen_detector(dark_first)
        beside = [
            other.project(sensor.pattern.corners()) for name, other in views.items() if name != view
        ]
        self._numbering = GridNumbering(self._nominal, dark_first, beside)
        self._markers = MeasuredMarkers(self._nominal, dark_first)
        method = sensor.tracking.virtual_markers
        self._virtual = VirtualMarkerLocator(sensor.pattern.shape, method)
        self._defects: PrintDefects | None = None
        self.reset()
        kind = sensor.pattern, sensor.tracking
        if kind not in _warm:
            self._warm_up(dark_first)
            _warm.add(kind)

    @property
    def print_defects(self) -> PrintDefects | None:
        """What is known of the print, from `inspect_print` or `heed`; None at first."""
        return self._defects

    def heed(self, defects: PrintDefects | None) -> None:
        """Trust what lies beside these flaws less from now on; None: the print is sound."""
        self._defects = defects

    def reset(self) -> None:
        """Forget what earlier frames showed; what is known of the print is kept."""
        self._last: NDArray[np.float64] | None = None
        self._confidence = 0.0

    def track(self, half_image: NDArray[np.uint8]) -> Grid:
        """Gridlines of a view image, (H, W) grey or (H, W, 3) BGR uint8, as `split_frame` cuts it.

        A grid that is not or partly seen is a normal result, with `Grid.fault` and `Grid.reason`.
        Raises FrameError for an image of another size or type.
        """
        placement = self._view.placement
        check_image(half_image, placement.width, placement.height, f"{self._view.name} view")
        part = self._window.cut(half_image)
        grey = to_grey(part, self._parameters.grey_weights, self._grey)
        if grey is not self._grey:
            np.copyto(self._grey, grey)
        image = self._image = self._prefilter.prepare(self._grey)
        last, self._last = self._last, None  # what goes wrong below shall not go on for ever
        torn = torn_rows(image)
        corners = None if torn else self._followed(image, last)
        if corners is not None:
            return self._grid(image, corners, Numbering(corners.position, ""), followed=True)
        graph = self._detector.corner_graph(image)
        numbering = self._numbering.number(graph, image, last, torn)
        corners = self._markers.measure(image, numbering.corners)
        if 0 < corners.missing < corners.std.size:
            corners = self._markers.complete(image, corners, numbering.corners)
            corners = self._markers.without_rims(corners)
        corners = self._markers.between(self._markers.mended(image, corners), numbering.between)
        corners, strays = self._markers.without_strays(corners)
        if not self._markers.is_bounded(image, corners.position):
            numbering, corners = self._numbering.unbounded(), corners.none()
        numbering = without_strays(numbering, strays, corners.missing)
        self._confidence = numbering.confidence
        return self._grid(image, corners, numbering, followed=False)

    def inspect_print(self, half_images: Iterable[NDArray[np.uint8]]) -> PrintDefects:
        """Judge the print from view images of the gel at rest.

        From now on corners beside a flaw get a larger standard deviation, and virtual markers on
        one are predicted instead of measured.  Raises ReferenceFramesError without images or where
        the gel moves in them, FrameError for a wrong one; what was known before is then kept.
        """
        kept, self._defects = self._defects, None
        inspection = PrintInspection(self._pattern.shape)
        origin = (float(self._window.x), float(self._window.y))
        try:
            for half_image in half_images:
                grid = self.track(half_image)
                inspection.add(self._image, grid, origin)
            self._defects = inspection.result()
        except BaseException:
            self._defects = kept
            raise
        return self._defects

    def _chosen_detector(self, dark_first: bool) -> GridlineDetector:
        if self._parameters.detector == "contour_stitching":
            return ContourStitching(self._nominal, dark_first)
        return SaddleLattice(self._nominal, self._grey.shape)

    def _followed(
        self, image: PreparedImage, last: NDArray[np.float64] | None
    ) -> MeasuredCorners | None:
        """The complete grid near its place in the last frame; None where that is in any doubt."""
        if not self._parameters.follow or last is None or np.isnan(last).any():
            return None
        corners = self._markers.measure(image, last)
        if corners.missing > 0.1 * corners.std.size:
            return None
        if corners.missing:
            corners = self._markers.complete(image, corners, np.full_like(last, np.nan))
        corners = self._markers.mended(image, corners)
        if corners.missing or not self._is_near(corners.position - last):
            return None
        if self._markers.without_strays(corners)[1]:
            return None
        return corners if self._markers.is_bounded(image, corners.position) else None

    def _is_near(self, moved: NDArray[np.float64]) -> bool:
        """Whether neighbours moved alike, (rows, cols, 2) px."""
        limit = LARGEST_CHANGE * self._nominal.side_px
        return all(bool((np.abs(np.diff(moved, axis=axis)) < limit).all()) for axis in (0, 1))

    def _grid(
        self,
        image: PreparedImage,
        corners: MeasuredCorners,
        numbering: Numbering,
        *,
        followed: bool,
    ) -> Grid:
        position = corners.position
        placement, shape = self._view.placement, self._pattern.shape
        known = np.isfinite(position[..., 0])
        self._last = position if known.any() else None
        fault, reason = self._complaint(image, numbering, known)
        if not known.any():
            return Grid.missing(shape, reason, placement, fault)
        std, predicted = corners.std, corners.predicted
        doubtful: list[NDArray[np.bool_] | None] = [None, None]
        if self._defects is not None:
            std = std / np.maximum(self._defects.corner_weight, LEAST_WEIGHT)
            predicted = predicted | (self._defects.corner_weight < LEAST_WEIGHT)
            doubtful = [self._defects.row_line_doubtful, self._defects.col_line_doubtful]
        rows, cols = self._virtual.locate(image, position, std, *doubtful)
        status = np.where(predicted, Status.PREDICTED, Status.MEASURED)
        origin = self._window.origin
        return Grid(
            shape=shape,
            corners=position + origin,
            corner_status=np.where(known, status, Status.MISSING).astype(np.uint8),
            row_lines=rows.position + origin,
            row_line_status=rows.status,
            col_lines=cols.position + origin,
            col_line_status=cols.status,
            residual_px=curve_residual(position),
            reason=reason,
            placement=placement,
            fault=fault,
            corner_std=std,
            row_line_std=rows.std,
            col_line_std=cols.std,
            confidence=self._confidence,
            followed=followed,
        )

    def _complaint(
        self, image: PreparedImage, numbering: Numbering, known: NDArray[np.bool_]
    ) -> tuple[GridFault, str]:
        """Fault and reason of what is missing in the end."""
        missing = int(known.size - known.sum())
        if not missing:
            return GridFault.NONE, ""
        if missing < known.size:
            fault = numbering.fault or GridFault.PARTLY_HIDDEN
            return fault, numbering.reason or f"{missing} corners not seen"
        fault, reason = image_fault(image.grey)
        if fault:
            return fault, reason
        return numbering.fault or GridFault.NO_PATTERN, numbering.reason or "no pattern seen"

    def _warm_up(self, dark_first: bool) -> None:
        """Compile, or load, all that a frame may need: not in the first frame."""
        place = self._view.placement
        picture = np.zeros((place.height, place.width), dtype=np.uint8)
        part = self._window.cut(picture)
        self.track(picture)
        drawn = draw_nominal(self._nominal, self._grey.shape, dark_first)
        for image in (drawn, drawn, *spoilt_pictures(drawn, self._nominal)):
            part[:] = image
            self.track(picture)
        part[:] = drawn
        self.inspect_print([picture])
        self.heed(None)
        self.reset()
