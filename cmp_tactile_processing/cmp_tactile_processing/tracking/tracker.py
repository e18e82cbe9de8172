"""The tracking stage: one view image in, its numbered gridlines out."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_processing.cache.threads import one_thread
from cmp_tactile_processing.errors import CalibrationError, InputError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.split import check_image, to_grey
from cmp_tactile_processing.image.prepared import Prefilter, PreparedImage
from cmp_tactile_processing.measured import Grid, GridFault, NumberingKind, Status
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parameters import TrackingParameters
from cmp_tactile_processing.sensor.parts import Pattern
from cmp_tactile_processing.tracking.contour_stitching.stitcher import ContourStitching
from cmp_tactile_processing.tracking.corners.bends import GridlineBends
from cmp_tactile_processing.tracking.corners.measured_markers import (
    MeasuredCorners,
    MeasuredMarkers,
)
from cmp_tactile_processing.tracking.corners.saddle_lattice import SaddleLattice
from cmp_tactile_processing.tracking.detector import (
    GridlineDetector,
    ImageWindow,
    NominalAxes,
    NominalGrid,
    draw_nominal,
    spoilt_pictures,
)
from cmp_tactile_processing.tracking.dots import read_dots
from cmp_tactile_processing.tracking.image_fault import image_fault
from cmp_tactile_processing.tracking.numbering.carried import CarriedNumbering, filled
from cmp_tactile_processing.tracking.numbering.faulty_view import (
    lattice_graph,
    proven_tears,
    torn_rows,
)
from cmp_tactile_processing.tracking.numbering.result import Numbering, not_seen, without_strays
from cmp_tactile_processing.tracking.numbering.whole_view import GridNumbering
from cmp_tactile_processing.tracking.print_inspection.defects import PrintDefects
from cmp_tactile_processing.tracking.print_inspection.inspector import PrintInspection
from cmp_tactile_processing.tracking.virtual_markers.locator import VirtualMarkerLocator

# From frame to frame the way to a neighbour changes by less than this share of a checker's side;
# where it changes by more, a corner has been taken for another one.
LARGEST_CHANGE = 0.3
# Of a pattern that goes on beyond the view corners may be missing within so many sides from the
# image's edge, up to such a share of the grid.
AT_EDGE, MOST_BEYOND_VIEW = 1.0, 0.5
# A corner of less weight is destroyed by a flaw of the print: it is where its surroundings have it.
LEAST_WEIGHT = 0.05
UNDESCRIBED_DOTS = (
    "the checkers have dots, but pattern.code is none: write code: dots and the sheet's code_seed "
    "into the description, so that a mirrored or turned view is recognised"
)
# What this process has compiled or loaded everything for: the other view of a sensor, or another
# tracker of it, is there at once.
_warm: set[tuple[Pattern, TrackingParameters]] = set()


class GridTracker:
    """Finds the gridlines of one view, and follows them from frame to frame.

    A complete grid is looked for where the last frame had it.  Everything is checked again in the
    image - each corner's colours, its edges to the neighbours, the pattern's border - and where
    anything is in doubt the grid is detected again from this image alone.
    Raises InputError for a view that the sensor does not have.
    """

    def __init__(self, sensor: SensorDescription, view: str = "left") -> None:
        views = build_views(sensor)
        if view not in views:
            msg = f"{sensor.name}: found no view '{view}', expected one of {', '.join(views)}"
            raise InputError(msg)
        self._view = views[view]
        self._pattern, self._parameters = sensor.pattern, sensor.tracking
        full = NominalGrid.of_view(sensor.pattern, self._view)
        place = self._view.placement
        self._window = full.window(place.width, place.height)
        self._goes_on = sensor.pattern.border == "beyond_view"
        if sensor.pattern.code != "none":
            # Any part of the pattern may be anywhere.
            self._window = ImageWindow(0, 0, place.width, place.height)
        self._nominal = full.seen_through(self._window)
        self._grey = np.empty((self._window.height, self._window.width), dtype=np.uint8)
        dark_first = sensor.pattern.corner_checker == "dark"
        self._prefilter = Prefilter(self._grey.shape, self._nominal.side_px)
        coded = sensor.pattern if sensor.pattern.code != "none" else None
        shown = full.with_surroundings(coded, self._view) if coded else full
        shown = shown.seen_through(self._window)
        self._detector = self._chosen_detector(shown, dark_first)
        beside = [
            other.project(sensor.pattern.corners()) for name, other in views.items() if name != view
        ]
        self._numbering: GridNumbering | CarriedNumbering
        if self._goes_on and coded is None:
            self._numbering = CarriedNumbering(self._nominal, dark_first)
            self._kind = NumberingKind.RELATIVE
        else:
            axes = NominalAxes(shown)
            self._numbering = GridNumbering(self._nominal, dark_first, beside, coded, axes)
            self._kind = NumberingKind.ABSOLUTE
        self._markers = MeasuredMarkers(self._nominal, dark_first)
        method = sensor.tracking.virtual_markers
        self._virtual = VirtualMarkerLocator(sensor.pattern.shape, method)
        self._defects: PrintDefects | None = None
        self._looks_for_dots, self._pattern_doubt = coded is None, ""
        self.reset()
        kind = sensor.pattern, sensor.tracking
        if kind not in _warm:
            self._warm_up(dark_first)
            _warm.add(kind)

    @property
    def pattern_doubt(self) -> str:
        """What the first grid shows of the pattern that the description lacks; or empty."""
        return self._pattern_doubt

    @property
    def print_defects(self) -> PrintDefects | None:
        """What `inspect_print` or `use_print_defects` made known of the print; None at first."""
        return self._defects

    def use_print_defects(self, defects: PrintDefects | None) -> None:
        """Allow for these flaws from now on; None: the print is sound."""
        self._defects = defects

    def reset(self) -> None:
        """Forget what earlier frames showed; what is known of the print is kept."""
        self._last: NDArray[np.float64] | None = None
        self._confidence = 0.0
        if isinstance(self._numbering, CarriedNumbering):
            self._numbering.reset()

    @one_thread()
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
        if self._defects is not None:
            self._defects.bands.take_out(self._grey)
        image = self._image = self._prefilter.prepare(self._grey)
        last, self._last = self._last, None  # an error below must not repeat in each frame
        torn = torn_rows(image)
        corners = self._followed(image, last)
        if corners is not None and not self._is_torn(image, corners.position, torn):
            return self._grid(image, corners, Numbering(corners.position, ""), followed=True)
        graph = self._detector.corner_graph(image)
        numbering = self._numbering.number(graph, image, last, torn)
        corners = self._markers.measure(image, numbering.corners)
        if 0 < corners.missing < corners.std.size:
            corners = self._markers.complete(image, corners, numbering.corners)
            corners = self._markers.without_rims(corners)
        corners = self._markers.between(
            self._markers.repair_outliers(image, corners), numbering.between
        )
        if not (self._goes_on or numbering.by_code):
            # Pieces that do not continue each other, and what lies beyond a border, are doubtful.
            corners, numbering = self._within_border(image, corners, numbering)
        self._confidence = numbering.confidence
        if self._looks_for_dots and 2 * corners.missing < corners.std.size:
            self._looks_for_dots = False
            even = self._pattern.corner_checker == "dark"
            if read_dots(image, corners.position, even).is_code:
                self._pattern_doubt = UNDESCRIBED_DOTS
        return self._grid(image, corners, numbering, followed=False)

    def inspect_print(self, half_images: Iterable[NDArray[np.uint8]]) -> PrintDefects:
        """Judge the print from view images of the gel at rest.

        From now on corners on a flaw are measured by their pictures at rest; where these do not
        fit, they get a larger standard deviation.  Virtual markers on a flaw are predicted.  Raises
        CalibrationError without images or where the gel moves in them, FrameError for a wrong
        one; what was known before is then kept.
        """
        kept, self._defects = self._defects, None
        inspection = PrintInspection(self._pattern.shape, self._pattern.dots())
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

    def _chosen_detector(self, shown: NominalGrid, dark_first: bool) -> GridlineDetector:
        if self._parameters.detector == "contour_stitching":
            return ContourStitching(shown, dark_first)
        return SaddleLattice(shown, self._grey.shape)

    def _followed(
        self, image: PreparedImage, last: NDArray[np.float64] | None
    ) -> MeasuredCorners | None:
        """The grid near its place in the last frame, but for corners beyond the view.

        None where that is in any doubt, or a corner in sight is missing.
        """
        if not self._parameters.follow or last is None or self._lacks(last):
            return None
        corners = self._markers.measure(image, last)
        if corners.missing - np.isnan(last[..., 0]).sum() > 0.1 * corners.std.size:
            return None
        if self._lacks(corners.position):
            corners = self._markers.complete(image, corners, np.full_like(last, np.nan))
        corners = self._markers.repair_outliers(image, corners)
        limit = LARGEST_CHANGE * self._nominal.side_px
        if self._lacks(corners.position) or not _moved_alike(corners.position, last, limit):
            return None
        if self._markers.without_strays(corners)[1]:
            return None
        return corners if self._confirmed(image, corners.position) else None

    def _lacks(self, corners: NDArray[np.float64]) -> bool:
        """Whether a corner is missing (rows, cols, 2) px that is not beyond the view."""
        missing = np.isnan(corners[..., 0])
        if not missing.any():
            return False
        if not self._goes_on or missing.mean() > MOST_BEYOND_VIEW:
            return True
        place, _ = filled(corners, self._nominal.corners)
        near = AT_EDGE * self._nominal.side_px
        inside = (place >= near) & (place <= np.array(self._grey.shape[::-1]) - 1 - near)
        return bool((missing & inside.all(axis=-1)).any())

    def _confirmed(self, image: PreparedImage, corners: NDArray[np.float64]) -> bool:
        """Whether it is certain that a followed grid bears the right numbers."""
        if isinstance(self._numbering, CarriedNumbering):
            return self._numbering.goes_on(corners)
        if self._goes_on:
            return self._numbering.confirms(corners, image)
        return self._markers.is_bounded(image, corners)

    def _within_border(
        self, image: PreparedImage, corners: MeasuredCorners, numbering: Numbering
    ) -> tuple[MeasuredCorners, Numbering]:
        """The corners less those of another pattern; none where further ones lie beyond them."""
        corners, strays = self._markers.without_strays(corners)
        if not self._markers.is_bounded(image, corners.position):
            reason = "there are further checkers beyond a border of the pattern"
            numbering = Numbering.nothing(corners.std.shape, GridFault.AMBIGUOUS, reason)
            corners = corners.none()
        return corners, without_strays(numbering, strays, corners.missing)

    def _is_torn(self, image: PreparedImage, corners: NDArray[np.float64], rows: list[int]) -> bool:
        """Whether a followed grid jumps where `torn_rows` suspects a tear."""
        if not rows:
            return False
        return bool(proven_tears(lattice_graph(corners), rows, image, self._nominal.side_px))

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
        if isinstance(self._numbering, CarriedNumbering):
            self._numbering.saw(position)
        fault, reason = self._complaint(image, numbering, known)
        if not known.any():
            return Grid.missing(shape, reason, placement, fault, self._kind)
        std, predicted, pull = corners.std, corners.predicted, corners.pull
        alone = predicted | corners.off_model
        doubtful: list[NDArray[np.bool_] | None] = [None, None]
        if self._defects is not None:
            std = std / np.maximum(self._defects.corner_weight, LEAST_WEIGHT)
            predicted = predicted | (self._defects.corner_weight < LEAST_WEIGHT)
            doubtful = [self._defects.row_line_doubtful, self._defects.col_line_doubtful]
            flawed = self._defects.flawed
            if flawed.known.any():
                position, std, found = flawed.measured(image, position, std, corners.predicted)
                predicted = predicted & ~found
                pull = np.where(found[..., None, None], 0.0, pull)
                alone |= found
            alone |= predicted
        bends = GridlineBends(position, std, pull)
        position = bends.corrected()
        rows, cols = self._virtual.locate(image, position, std, *doubtful)
        # Virtual markers show how gridlines bend close to a corner; other corners are farther off.
        bends.add_markers(position, rows.position, cols.position)
        position = bends.corrected()
        position, std = self._fused(position, std, alone)
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
            numbering=self._kind,
        )

    def _fused(
        self,
        position: NDArray[np.float64],
        std: NDArray[np.float64],
        alone: NDArray[np.bool_],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Corners with what the gridlines through them know, but for those that stand alone.

        Where the print is flawed, corner and lines are off by other amounts in each frame.
        """
        crossing, crossing_std = self._virtual.crossings(position)
        kept = alone | np.isnan(std)
        position = np.where(kept[..., None], position, crossing)
        return position, np.where(kept, std, crossing_std)

    def _complaint(
        self, image: PreparedImage, numbering: Numbering, known: NDArray[np.bool_]
    ) -> tuple[GridFault, str]:
        """Fault and reason of what is missing in the end."""
        missing = int(known.size - known.sum())
        if not missing:
            return GridFault.NONE, ""
        if missing < known.size:
            fault = numbering.fault or GridFault.PARTLY_HIDDEN
            return fault, numbering.reason or not_seen(missing)
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
        dots = self._pattern.dots()
        drawn = draw_nominal(self._nominal, self._grey.shape, dark_first, dots)
        for image in (drawn, drawn, *spoilt_pictures(drawn, self._nominal)):
            part[:] = image
            self.track(picture)
        part[:] = drawn
        # By a wrong description, the pattern may lie outside the view.
        with suppress(CalibrationError):
            self.inspect_print([picture])
        self.use_print_defects(None)
        self._looks_for_dots = self._pattern.code == "none"
        self.reset()


@kernel
def _moved_alike(corners: NDArray[np.float64], last: NDArray[np.float64], limit: float) -> bool:
    """Whether neighbours moved alike between two frames (rows, cols, 2), to `limit` px.

    Corners that are NaN in either count for nothing.
    """
    rows, cols = corners.shape[:2]
    for i in range(rows):
        for j in range(cols):
            for d in range(2):
                moved = corners[i, j, d] - last[i, j, d]
                if i > 0 and abs(moved - (corners[i - 1, j, d] - last[i - 1, j, d])) >= limit:
                    return False
                if j > 0 and abs(moved - (corners[i, j - 1, d] - last[i, j - 1, d])) >= limit:
                    return False
    return True


# How well smooth curves fit the corners.


def curve_residual(corners: NDArray[np.float64]) -> float:
    """RMS distance of corners (rows, cols, 2) from the cubics through their four neighbours, px.

    NaN where no corner has two measured neighbours on either side.
    """
    total, count = _squares(corners)
    # The combination's own noise is 1.39 times a corner's: scale back to one corner's.
    return float(np.sqrt(total / (count * (1 + 34 / 36)))) if count else float("nan")


@kernel
def _squares(corners: NDArray[np.float64]) -> tuple[float, int]:
    """Sum of the squared distances in `curve_residual`, and how many there are."""
    rows, cols = corners.shape[:2]
    total, count = 0.0, 0
    for di, dj in ((1, 0), (0, 1)):
        for i in range(2 * di, rows - 2 * di):
            for j in range(2 * dj, cols - 2 * dj):
                square = 0.0
                for d in range(2):
                    near = corners[i - di, j - dj, d] + corners[i + di, j + dj, d]
                    far = corners[i - 2 * di, j - 2 * dj, d] + corners[i + 2 * di, j + 2 * dj, d]
                    square += (corners[i, j, d] - (4 * near - far) / 6) ** 2
                if np.isfinite(square):
                    total, count = total + square, count + 1
    return total, count
