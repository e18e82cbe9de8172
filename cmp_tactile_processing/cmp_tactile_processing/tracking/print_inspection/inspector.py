"""Inspection of a print at rest: what is wrong in the mean of its frames, and what that spoils."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import CalibrationError, InputError
from cmp_tactile_processing.image.light_bands import LightBands
from cmp_tactile_processing.image.prepared import QUANTISATION, PreparedImage
from cmp_tactile_processing.measured import Grid, GridShape, Status
from cmp_tactile_processing.sensor.dot_code import DOT_DIAMETER
from cmp_tactile_processing.tracking.print_inspection.defects import (
    Defect,
    DefectKind,
    PrintDefects,
    Spot,
)
from cmp_tactile_processing.tracking.print_inspection.flawed_corners import FlawedCorners
from cmp_tactile_processing.tracking.print_inspection.picture import (
    PrintPlaces,
)
from cmp_tactile_processing.tracking.print_inspection.view import (
    LineScatter,
    PrintView,
    overall_raggedness,
    sampled,
    side_of_checkers,
)

# A segment is a defect if its markers stray this many times as far as those of the others, and by
# this, over at least so many markers.
MIN_RAGGED_RATIO = 2.5
MIN_RAGGED_PX = 0.3
MIN_RAGGED_MARKERS = 3
# If the edges stray by more than this (px, rms), every corner is flawed; else one whose standard
# deviation is so many times the median.
RAGGED_PX, FAR_OFF = 0.08, 4.0

# Frames in which the corners lie farther apart than this, in the median, are not of one rest, px.
SAME_REST_PX = 0.5
# What shows less of the pattern says nothing about the print.
LEAST_SEEN = 0.5


class PrintInspection:
    """Inspects a print in one frame at rest or, better, in the mean of several.

    shape: numbers of corners and virtual markers.  dots (rows + 1, cols + 1): checkers that bear
    one, which is no defect; None where none does.
    """

    def __init__(self, shape: GridShape, dots: NDArray[np.bool_] | None = None) -> None:
        self._shape = shape
        self._dots = dots
        self._mean: MeanFrame | None = None

    def add(
        self, image: PreparedImage, grid: Grid, origin: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """Take in a frame; origin: the prepared image's first pixel in the view, px.

        Raises CalibrationError where half of the corners are missing or the gel has moved since
        the first frame, and InputError for a grid or an image of another size.
        """
        mean = self._mean or MeanFrame(self._shape, image.grey.shape)
        mean.add(image, grid, origin)
        self._mean = mean

    def result(self) -> PrintDefects:
        """The state of the print as all frames show it; CalibrationError without frames."""
        if self._mean is None:
            msg = "print inspection: found no frames, expected at least one at rest"
            raise CalibrationError(msg)
        found = _judged(self._mean)
        if self._dots is None:
            return found
        defects = tuple(item for item in found.defects if not _is_dot(item, self._dots))
        return replace(found, defects=defects)


def _is_dot(defect: Defect, dots: NDArray[np.bool_]) -> bool:
    """Whether a defect lies in the middle of a checker that bears a dot."""
    place = np.array([defect.row, defect.col]) + 0.5
    checker = np.clip(np.rint(place), 0, np.array(dots.shape) - 1).astype(np.intp)
    near = np.linalg.norm(place - checker) <= DOT_DIAMETER
    return bool(near and dots[checker[0], checker[1]])


def _judged(frame: MeanFrame) -> PrintDefects:
    corners = frame.corners
    if np.isnan(corners).all():
        return _unjudged(frame)
    side = side_of_checkers(corners)
    low = np.maximum(np.floor(np.nanmin(corners, axis=(0, 1)) - 1.5 * side), 0).astype(int)
    high = np.ceil(np.nanmax(corners, axis=(0, 1)) + 1.5 * side).astype(int) + 1
    part = np.ascontiguousarray(frame.image[low[1] : high[1], low[0] : high[0]])
    steady = ~frame.bands.changing[low[1] : high[1]]
    seen = PrintView.in_image(part, frame.noise, corners - low, steady)
    if seen is None:
        return _unjudged(frame)
    first = frame.origin + low
    scatters = []
    for index in range(2):
        lines, std = frame.line(index)
        scatters.append(seen.scatter(lines - low, std, along_rows=index == 0))
    spots = [_spot(spot, seen.places, first) for spot in seen.spots.spots]
    weight, raggedness = seen.corner_weight(), overall_raggedness(scatters)
    flawed = (weight < 1) | frame.far_off | (raggedness > RAGGED_PX)
    flawed &= seen.judged_corners
    return PrintDefects(
        corner_weight=weight,
        row_line_doubtful=scatters[0].doubtful,
        col_line_doubtful=scatters[1].doubtful,
        row_raggedness=scatters[0].raggedness,
        col_raggedness=scatters[1].raggedness,
        raggedness_px=raggedness,
        defects=(*spots, *_ragged_edges(scatters, seen, first)),
        judged=seen.judged,
        frames=frame.frames,
        bands=frame.bands,
        flawed=frame.pictures(seen.lattice.corners(*corners.shape[:2]) + low, flawed),
    )


def _unjudged(frame: MeanFrame) -> PrintDefects:
    shape = frame.shape
    return PrintDefects(
        corner_weight=np.ones(shape.corners),
        row_line_doubtful=np.zeros(shape.row_lines, bool),
        col_line_doubtful=np.zeros(shape.col_lines, bool),
        row_raggedness=np.full(shape.row_lines[:2], np.nan),
        col_raggedness=np.full(shape.col_lines[:2], np.nan),
        raggedness_px=float("nan"),
        defects=(),
        judged=0.0,
        frames=frame.frames,
        bands=frame.bands,
        flawed=frame.pictures(frame.corners, np.zeros(shape.corners, bool)),
    )


def _spot(spot: Spot, places: PrintPlaces, first: NDArray[np.float64]) -> Defect:
    row, col = (float(sampled(places.number[..., axis], spot.centre_px)) for axis in (0, 1))
    return Defect(spot.kind, row, col, spot.centre_px + first, spot.extent_px, spot.strength)


def _ragged_edges(
    scatters: list[LineScatter], seen: PrintView, first: NDArray[np.float64]
) -> list[Defect]:
    """Segments whose edge strays much more than the others'."""
    usual = overall_raggedness(scatters, with_noise=True)
    found = []
    for scatter, (down, right) in zip(scatters, ((0.0, 0.5), (0.5, 0.0)), strict=True):
        with np.errstate(invalid="ignore"):
            ragged = scatter.raggedness > max(MIN_RAGGED_RATIO * usual, MIN_RAGGED_PX)
        for i, j in np.argwhere(ragged & (scatter.count >= MIN_RAGGED_MARKERS)):
            row, col = i + down, j + right
            centre = seen.lattice.at(np.array([row]), np.array([col]))[0, 0] + first
            strength = float(scatter.raggedness[i, j])
            place = float(row), float(col), centre
            found.append(Defect(DefectKind.RAGGED_EDGE, *place, seen.side_px, strength))
    return found


# The mean of several frames of one print at rest.


class _Mean:
    """Mean over frames of an array of points, each over the frames in which it was measured."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._total = np.zeros(shape)
        self._count = np.zeros(shape[:-1])

    def add(self, points: NDArray[np.float64], measured: NDArray[np.bool_]) -> None:
        known = measured & np.isfinite(points).all(axis=-1)
        self._total[known] += points[known]
        self._count += known

    @property
    def value(self) -> NDArray[np.float64]:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(self._total / self._count[..., None])


class MeanFrame:
    """Frames at rest, averaged: image (H, W), points in its pixels, noise of the mean."""

    def __init__(self, shape: GridShape, size: tuple[int, int]) -> None:
        self.shape = shape
        self._sum, self._smooth = np.zeros((2, *size), dtype=np.float32)
        self._smoothing_px = 0.0
        self.frames = 0
        self.bands = LightBands(size[0])
        self.origin = np.zeros(2)
        self._noise2 = 0.0
        self._first: NDArray[np.float64] | None = None
        self._corners, self._stds = _Mean((*shape.corners, 2)), _Mean((*shape.corners, 1))
        self._lines = [_Mean((*lines, 2)) for lines in (shape.row_lines, shape.col_lines)]
        self._variances = [_Mean((*lines, 1)) for lines in (shape.row_lines, shape.col_lines)]

    def add(self, image: PreparedImage, grid: Grid, origin: tuple[float, float]) -> None:
        """Take in a frame; raises as `PrintInspection.add` does."""
        if grid.shape != self.shape:
            msg = f"print inspection: found a grid of {grid.shape}, expected {self.shape}"
            raise InputError(msg)
        if image.grey.shape != self._sum.shape:
            msg = f"print inspection: found an image of {image.grey.shape}, expected "
            raise InputError(f"{msg}{self._sum.shape}")
        corners = np.where((grid.corner_status == Status.MEASURED)[..., None], grid.corners, np.nan)
        self.bands.add(image.grey)
        self._check_rest(corners, origin)
        self._sum += image.grey
        self._smooth += image.smooth
        self._smoothing_px += image.smoothing_px
        self._noise2 += image.noise**2 + QUANTISATION**2
        self.frames += 1
        seen = np.isfinite(corners[..., 0])
        self._corners.add(corners - self.origin, seen)
        if grid.corner_std is not None:
            self._stds.add(grid.corner_std[..., None], seen)
        lines = (
            (grid.row_lines, grid.row_line_status, grid.row_line_std),
            (grid.col_lines, grid.col_line_status, grid.col_line_std),
        )
        for index, (points, status, std) in enumerate(lines):
            measured = status == Status.MEASURED
            self._lines[index].add(points - self.origin, measured)
            if std is not None:
                self._variances[index].add(std[..., None] ** 2, measured)

    def _check_rest(self, corners: NDArray[np.float64], origin: tuple[float, float]) -> None:
        seen = float(np.mean(np.isfinite(corners[..., 0])))
        if seen < LEAST_SEEN:
            msg = (
                f"print inspection: found {seen:.0%} of the corners in a frame, expected at least "
                f"{LEAST_SEEN:.0%}"
            )
            raise CalibrationError(msg)
        if self._first is None:
            self._first, self.origin = corners, np.array(origin, dtype=np.float64)
            return
        moved = np.linalg.norm(corners - self._first, axis=-1)
        moved = moved[np.isfinite(moved)]
        shift = float(np.median(moved)) if len(moved) else 0.0
        if shift > SAME_REST_PX or tuple(self.origin) != tuple(origin):
            msg = (
                f"print inspection: found the gel {shift:.2f} px from its place in the first "
                f"frame, expected less than {SAME_REST_PX} px: the gel must be at rest in all "
                "frames"
            )
            flicker = self.bands.report
            raise CalibrationError(f"{msg}; {flicker}" if flicker else msg)

    @property
    def image(self) -> NDArray[np.float32]:
        """The mean image (H, W)."""
        return np.asarray(self._sum / np.float32(self.frames), dtype=np.float32)

    @property
    def noise(self) -> float:
        """Standard deviation of the mean image's noise, grey levels."""
        return float(np.sqrt(self._noise2) / self.frames)

    def pictures(self, sound: NDArray[np.float64], flawed: NDArray[np.bool_]) -> FlawedCorners:
        """Pictures of some corners (rows, cols), as far as they were measured; sound: where a sound
        print would show all corners, (rows, cols, 2) px.
        """
        smooth = self._smooth / np.float32(self.frames)
        smoothing_px = self._smoothing_px / self.frames
        return FlawedCorners.at_rest(smooth, smoothing_px, self.corners, sound, flawed)

    @property
    def corners(self) -> NDArray[np.float64]:
        """Mean corners (rows, cols, 2), NaN where never measured."""
        return self._corners.value

    @property
    def far_off(self) -> NDArray[np.bool_]:
        """Corners (rows, cols) of a much larger deviation than most."""
        std = self._stds.value[..., 0]
        known = std[np.isfinite(std)]
        usual = np.median(known) if len(known) else np.inf
        return np.asarray(std > FAR_OFF * usual)

    def line(self, index: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean markers (a, b, n, 2) along rows (0) or columns (1) and their std, NaN if unknown."""
        std = np.sqrt(self._variances[index].value[..., 0] / self.frames)
        return self._lines[index].value, std
