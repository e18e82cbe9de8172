"""The tracking stage: one view image in, its numbered gridlines out."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.contour_stitching import (
    Pretreatment,
    build_graph,
    find_checkers,
    merge_corners,
)
from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.grid import Grid, Status
from cmp_tactile_processing.gridline_curves import curve_residual
from cmp_tactile_processing.gridline_pointer import drop_strained, traverse
from cmp_tactile_processing.measured_markers import complete_corners, refine_corners
from cmp_tactile_processing.nominal_grid import NominalGrid
from cmp_tactile_processing.numbering import Numbering, number_corners
from cmp_tactile_processing.optics import build_views
from cmp_tactile_processing.sensor_description import SensorDescription
from cmp_tactile_processing.split import check_image, to_grey
from cmp_tactile_processing.virtual_markers import locate_virtual_markers

__all__ = ["GridTracker"]

# Tried in turn until one shows the whole grid; the paper repeats its pretreatment likewise.
DARK_PRETREATMENTS = (Pretreatment(1.5, 2), Pretreatment(1.5, 1), Pretreatment(2.0, 3))
LIGHT_PRETREATMENTS = tuple(replace(item, dark=False) for item in DARK_PRETREATMENTS)
# The light checkers are tried only where the dark ones showed less than this share of the corners:
# a dark margin joins the outermost dark checkers to one blob.
ENOUGH_FROM_DARK = 0.5
# What a further pretreatment must add to go on; the last corners are found without outlines.
LITTLE_GAIN = 0.02
# Outlines are taken at this side of a checker at least; smaller checkers are magnified for it.
MAGNIFY_BELOW_PX = 10.0
# Smoothing before saddle points and gradients are measured, px: the lens blurs by about as much.
SMOOTHING_PX = 1.2
# Share of pixels that stand out from their neighbours by a quarter of the image's grey range,
# above which the image is taken to carry salt and pepper and is median-filtered.
SALT_AND_PEPPER = 0.001


class GridTracker:
    """Finds the gridlines of one view by contour stitching, anew in every frame.

    Raises GeometryError for a view that the sensor does not have.
    """

    def __init__(self, sensor: SensorDescription, view: str = "left") -> None:
        views = build_views(sensor)
        if view not in views:
            msg = f"{sensor.name}: found no view '{view}', expected one of {', '.join(views)}"
            raise GeometryError(msg)
        self._view = views[view]
        self._pattern = sensor.pattern
        nominal = NominalGrid.of_view(sensor.pattern, self._view)
        place = self._view.placement
        self._window = nominal.window(place.width, place.height)
        self._nominal = nominal.seen_through(self._window)
        self._dark_first = sensor.pattern.corner_checker == "dark"
        self._magnification = int(np.ceil(MAGNIFY_BELOW_PX / self._nominal.smallest_side_px))
        self._magnified = self._nominal.magnified(self._magnification)

    def reset(self) -> None:
        """Forget what earlier frames showed; this detector keeps nothing from frame to frame."""

    def track(self, half_image: NDArray[np.uint8]) -> Grid:
        """Gridlines of a view image, (H, W) grey or (H, W, 3) BGR uint8, as `split_frame` cuts it.

        A grid that is not or partly seen is a normal result, with the reason in `Grid.reason`.
        Raises FrameError for an image of another size or type.
        """
        placement = self._view.placement
        check_image(half_image, placement.width, placement.height, f"{self._view.name} view")
        grey = self._window.cut(to_grey(half_image))
        median = np.asarray(cv2.medianBlur(grey, 3), dtype=np.uint8)
        clean = median if _has_salt_and_pepper(grey, median) else grey
        blurred = cv2.GaussianBlur(clean.astype(np.float32), (0, 0), SMOOTHING_PX)
        smooth = np.asarray(blurred, dtype=np.float32)
        numbering = self._refined(self._detect(median), smooth)
        if np.isnan(numbering.corners).all():
            return Grid.missing(self._pattern.shape, numbering.reason, placement)
        return self._with_virtual_markers(numbering, smooth)

    def _detect(self, median: NDArray[np.uint8]) -> Numbering:
        """Corners by contour stitching, to a pixel or two, of the best pretreatment."""
        best = Numbering(np.full_like(self._nominal.corners, np.nan), "")
        most, total = -1, best.corners[..., 0].size
        factor = self._magnification
        if factor > 1:
            magnified = cv2.resize(median, None, fx=factor, fy=factor)
            median = np.asarray(magnified, dtype=np.uint8)
        for pretreatment in (*DARK_PRETREATMENTS, *LIGHT_PRETREATMENTS):
            enough = most > ENOUGH_FROM_DARK * total
            if enough and not pretreatment.dark:
                break
            numbering = self._stitched(median, pretreatment)
            gain = int(np.isfinite(numbering.corners[..., 0]).sum()) - most
            if gain > 0:
                best, most = numbering, most + gain
            if not numbering.reason or (enough and gain < LITTLE_GAIN * total):
                break
        return replace(best, corners=(best.corners + 0.5) / factor - 0.5)

    def _stitched(self, median: NDArray[np.uint8], pretreatment: Pretreatment) -> Numbering:
        """Numbered corners in pixels of the magnified window."""
        nominal = self._magnified
        checkers = find_checkers(median, nominal, pretreatment)
        graph = build_graph(checkers, merge_corners(checkers, nominal.side_px))
        graph = drop_strained(graph, *nominal.axes_near(graph.position))
        return number_corners(traverse(graph), nominal, self._dark_first == pretreatment.dark)

    def _refined(self, numbering: Numbering, smooth: NDArray[np.float32]) -> Numbering:
        if np.isnan(numbering.corners).all():
            return numbering
        side = self._nominal.side_px
        corners = refine_corners(smooth, numbering.corners, side, self._dark_first)
        if np.isnan(corners).any():
            corners = complete_corners(smooth, corners, side, self._dark_first)
        missing = int(np.isnan(corners[..., 0]).sum())
        return Numbering(corners, f"{missing} corners not seen" if missing else "")

    def _with_virtual_markers(self, numbering: Numbering, smooth: NDArray[np.float32]) -> Grid:
        corners, count = numbering.corners, self._pattern.points_per_segment
        rows = locate_virtual_markers(smooth, corners, count)
        cols = locate_virtual_markers(smooth, corners.swapaxes(0, 1), count)
        measured = np.isfinite(corners[..., 0])
        origin = self._window.origin
        return Grid(
            shape=self._pattern.shape,
            corners=corners + origin,
            corner_status=np.where(measured, Status.MEASURED, Status.MISSING).astype(np.uint8),
            row_lines=rows.position + origin,
            row_line_status=rows.status,
            col_lines=np.ascontiguousarray(cols.position.swapaxes(0, 1)) + origin,
            col_line_status=np.ascontiguousarray(cols.status.swapaxes(0, 1)),
            residual_px=curve_residual(corners),
            reason=numbering.reason,
            placement=self._view.placement,
        )


def _has_salt_and_pepper(grey: NDArray[np.uint8], median: NDArray[np.uint8]) -> bool:
    """Whether single pixels stand out; a median filter costs a little accuracy elsewhere."""
    jump = max(int(np.ptp(grey[::8, ::8])) // 4, 8)
    outliers = np.count_nonzero(cv2.absdiff(grey, median) > jump)
    return bool(outliers > SALT_AND_PEPPER * grey.size)
