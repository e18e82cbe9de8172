"""Inspection of a print at rest: missing ink, dirt, ragged edges, and what that makes doubtful."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ReferenceFramesError
from cmp_tactile_processing.grid import Grid, GridShape
from cmp_tactile_processing.prepared_image import PreparedImage
from cmp_tactile_processing.print_defects import Defect, DefectKind, PrintDefects
from cmp_tactile_processing.print_edges import LineScatter, line_scatter, raggedness
from cmp_tactile_processing.print_frames import MeanFrame
from cmp_tactile_processing.print_lattice import PrintPlaces, SmoothLattice, places_in_image
from cmp_tactile_processing.print_picture import Departure, departure
from cmp_tactile_processing.print_spots import Spot, Spots, find_spots

__all__ = ["PrintInspection"]

# Too little of a grid to tell where the print should be.
LEAST_CORNERS, LEAST_SHARE = 9, 0.3
# How far beyond the outermost corners the print is inspected, checkers: its rim's place is not
# measured, and blurred.
RIM = 0.6
# Where the lattice is extrapolated by a checker, edges may stray by so many times as much more.
RIM_STRAYING = 2.0
# A hole of up to two missing corners across is part of what is inspected: a spot made it.
HOLE = 3
# Half the width of the Gaussian window in which a spot spoils a corner, as a share of the side,
# and at least, px; and the shares of that window whose loss weakens and destroys the corner.
CORNER_WINDOW, LEAST_WINDOW_PX, WEAKENED, DESTROYED = 0.12, 1.2, 0.05, 0.5
# A corner so many typical deviations from the smooth lattice begins to lose weight.
CORNER_DEVIATIONS, LEAST_DEVIATION_PX = 4.0, 0.05
# A spot so near to a virtual marker, besides the blur, bends its gradient, px.
SPOT_REACH_PX = 1.5
# A virtual marker so many typical deviations off its smooth curve is astray.
MARKER_DEVIATIONS, LEAST_ASTRAY_PX = 5.0, 0.25
# A segment is a defect of its own where it strays so many times as far as the others and so far.
RAGGED_RATIO, LEAST_RAGGED_PX = 2.5, 0.3


class PrintInspection:
    """Judges a print from one frame at rest or, better, from the mean of several.

    shape: numbers of corners and virtual markers.  `inspect` judges one frame; `add` frames and
    take the `result` to average the noise away.
    """

    def __init__(self, shape: GridShape) -> None:
        self._shape = shape
        self._mean: MeanFrame | None = None

    def inspect(
        self, image: PreparedImage, grid: Grid, origin: tuple[float, float] = (0.0, 0.0)
    ) -> PrintDefects:
        """The state of the print as this one frame shows it; see `add`."""
        frame = MeanFrame(self._shape, image.grey.shape)
        frame.add(image, grid, origin)
        return _judged(frame)

    def add(
        self, image: PreparedImage, grid: Grid, origin: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """Take in a frame; origin: the prepared image's first pixel in the view, px.

        Raises ReferenceFramesError where the gel has moved since the first frame, and
        GeometryError for a grid or an image of another size.
        """
        if self._mean is None:
            frame = MeanFrame(self._shape, image.grey.shape)
            frame.add(image, grid, origin)
            self._mean = frame
        else:
            self._mean.add(image, grid, origin)

    def result(self) -> PrintDefects:
        """The state of the print as all frames show it; ReferenceFramesError without frames."""
        if self._mean is None:
            msg = "print inspection: found no frames, expected at least one at rest"
            raise ReferenceFramesError(msg)
        return _judged(self._mean)

    def reset(self) -> None:
        """Forget the frames."""
        self._mean = None


@dataclass(frozen=True)
class _SeenPrint:
    """The part of a mean frame that shows the print, judged; places in px of that part.

    corners (rows, cols, 2): as measured.  usable (H, W): pixels that could be judged.
    """

    corners: NDArray[np.float64]
    lattice: SmoothLattice
    places: PrintPlaces
    usable: NDArray[np.bool_]
    departure: Departure
    spots: Spots
    side_px: float

    @classmethod
    def in_image(
        cls, image: NDArray[np.float32], noise: float, corners: NDArray[np.float64]
    ) -> _SeenPrint | None:
        """None where the image (H, W) has no contrast or too little of the print."""
        known = np.isfinite(corners[..., 0])
        if known.sum() < max(LEAST_CORNERS, LEAST_SHARE * known.size):
            return None
        side = _side_px(corners)
        lattice = SmoothLattice.through(corners)
        places = places_in_image(lattice, known.shape, image.shape)
        usable = _usable(places.number, known)
        found = departure(image, noise, places, usable, side)
        if found is None:
            return None
        last = np.array([count - 1 for count in known.shape], dtype=np.float32)
        number = np.where(usable[..., None], places.number, 0)
        beyond = np.maximum(np.maximum(-number, number - last).max(axis=-1), 0)
        spots = find_spots(found, usable, 1 + RIM_STRAYING * beyond, side)
        return cls(corners, lattice, places, usable & ~spots.glare, found, spots, side)

    @property
    def judged(self) -> float:
        """Share of the print that could be judged, 0 to 1."""
        rows, cols = self.corners.shape[:2]
        whole = (rows - 1 + 2 * RIM) * (cols - 1 + 2 * RIM)
        return float(min(1.0, np.count_nonzero(self.usable) * self._checkers_per_px / whole))

    @property
    def _checkers_per_px(self) -> float:
        """Mean over the usable pixels of the area of one, in checkers."""
        number, usable = self.places.number, self.usable[:-1, :-1]
        right = (number[:-1, 1:] - number[:-1, :-1])[usable]
        down = (number[1:, :-1] - number[:-1, :-1])[usable]
        area = np.abs(right[:, 0] * down[:, 1] - right[:, 1] * down[:, 0])
        return float(np.nanmean(area)) if len(area) else 0.0

    def corner_weight(self) -> NDArray[np.float64]:
        """Weight of each corner (rows, cols), 0 to 1."""
        window = max(LEAST_WINDOW_PX, CORNER_WINDOW * self.side_px)
        covered = self.spots.covered.astype(np.float32)
        lost = np.asarray(cv2.GaussianBlur(covered, (0, 0), window), dtype=np.float32)
        i, j = (np.arange(count, dtype=np.float64) for count in self.corners.shape[:2])
        smooth = self.lattice.at(i, j)
        weight = np.clip((DESTROYED - _sampled(lost, smooth)) / (DESTROYED - WEAKENED), 0, 1)
        usual = CORNER_DEVIATIONS * max(self.lattice.deviation_px, LEAST_DEVIATION_PX)
        distance = np.linalg.norm(self.corners - smooth, axis=-1)
        known = np.isfinite(distance)
        weight *= np.where(known, usual / np.maximum(np.where(known, distance, 0), usual), 1)
        # Not found at rest, amid others that were: there is nothing to measure.
        hole = ~known & (_sampled(self.usable.astype(np.float32), smooth) > 0)
        return np.where(hole, 0.0, weight)

    def scatter(
        self, lines: NDArray[np.float64], std: NDArray[np.float64], along_rows: bool
    ) -> tuple[LineScatter, NDArray[np.bool_]]:
        """Scatter of virtual markers lines (a, b, n, 2) px, and which of them are doubtful.

        std (a, b, n): their noise, px; where it is NaN, what the image's noise makes of it.
        """
        scatter = line_scatter(self.lattice, lines, along_rows)
        slope = np.maximum(_sampled(self.spots.gradient, scatter.smooth), 1e-3)
        by_image = _sampled(self.departure.noise, scatter.smooth) / slope
        scatter = replace(scatter, std=np.where(np.isnan(std), by_image, std))
        reach = SPOT_REACH_PX + _sampled(self.departure.blur, scatter.smooth)
        doubtful = _sampled(self._to_spot, scatter.smooth) < reach
        distance = np.abs(scatter.across)
        known = np.isfinite(distance)
        if known.any():
            usual = 1.4826 * float(np.median(distance[known]))
            doubtful |= known & (distance > max(MARKER_DEVIATIONS * usual, LEAST_ASTRAY_PX))
        return scatter, doubtful

    @cached_property
    def _to_spot(self) -> NDArray[np.float32]:
        """Distance of each pixel (H, W) from the nearest spot, px."""
        if not self.spots.covered.any():
            return np.full(self.spots.covered.shape, np.inf, dtype=np.float32)
        clear = 1 - self.spots.covered.astype(np.uint8)
        return np.asarray(cv2.distanceTransform(clear, cv2.DIST_L2, 5), dtype=np.float32)


def _judged(frame: MeanFrame) -> PrintDefects:
    corners = frame.corners
    if np.isnan(corners).all():
        return _unjudged(frame)
    side = _side_px(corners)
    low = np.maximum(np.floor(np.nanmin(corners, axis=(0, 1)) - 1.5 * side), 0).astype(int)
    high = np.ceil(np.nanmax(corners, axis=(0, 1)) + 1.5 * side).astype(int) + 1
    part = np.ascontiguousarray(frame.image[low[1] : high[1], low[0] : high[0]])
    seen = _SeenPrint.in_image(part, frame.noise, corners - low)
    if seen is None:
        return _unjudged(frame)
    first = frame.origin + low
    doubtful, parts, square, count = [], [], 0.0, 0
    for index in range(2):
        lines, std = frame.line(index)
        scatter, astray = seen.scatter(lines - low, std, along_rows=index == 0)
        part_rms, part_square, part_count = raggedness(scatter.without(astray))
        doubtful.append(astray)
        parts.append(part_rms)
        square, count = square + part_square, count + part_count
    overall = float(np.sqrt(max(square / count, 0))) if count else float("nan")
    spots = [_spot(spot, seen.places, first) for spot in seen.spots.spots]
    return PrintDefects(
        corner_weight=seen.corner_weight(),
        row_line_doubtful=doubtful[0],
        col_line_doubtful=doubtful[1],
        row_raggedness=parts[0],
        col_raggedness=parts[1],
        raggedness_px=overall,
        defects=(*spots, *_ragged_edges(parts, overall, seen, first)),
        judged=seen.judged,
        frames=frame.frames,
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
    )


def _side_px(corners: NDArray[np.float64]) -> float:
    """Median side of a checker, px."""
    steps = [np.linalg.norm(np.diff(corners, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    sides = np.concatenate(steps)
    sides = sides[np.isfinite(sides)]
    return float(np.median(sides)) if len(sides) else 1.0


def _usable(number: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels (H, W) of the print, up to its rim, on checkers whose corners are known."""
    rows, cols = known.shape
    padded = np.pad(known, HOLE, mode="edge").astype(np.uint8)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((HOLE, HOLE), np.uint8))
    whole = np.asarray(closed, dtype=bool)[HOLE - 1 : -HOLE + 1, HOLE - 1 : -HOLE + 1]
    checker = whole[:-1, :-1] & whole[1:, :-1] & whole[:-1, 1:] & whole[1:, 1:]
    with np.errstate(invalid="ignore"):
        i, j = number[..., 0], number[..., 1]
        inside = (i >= -RIM) & (i <= rows - 1 + RIM) & (j >= -RIM) & (j <= cols - 1 + RIM)
    usable = np.zeros(inside.shape, bool)
    # The outermost checkers begin at -1.
    usable[inside] = checker[(i[inside] + 1).astype(int), (j[inside] + 1).astype(int)]
    return usable


def _sampled(image: NDArray[np.float32], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """The image (H, W) at the pixels nearest to q (..., 2)."""
    height, width = image.shape
    x = np.clip(np.rint(q[..., 0]), 0, width - 1).astype(int)
    y = np.clip(np.rint(q[..., 1]), 0, height - 1).astype(int)
    return np.asarray(image[y, x], dtype=np.float64)


def _spot(spot: Spot, places: PrintPlaces, first: NDArray[np.float64]) -> Defect:
    row, col = (float(_sampled(places.number[..., axis], spot.centre_px)) for axis in (0, 1))
    return Defect(spot.kind, row, col, spot.centre_px + first, spot.extent_px, spot.strength)


def _ragged_edges(
    parts: list[NDArray[np.float64]], overall: float, seen: _SeenPrint, first: NDArray[np.float64]
) -> list[Defect]:
    """Segments whose edge strays much more than the others'."""
    found = []
    for index, segments in enumerate(parts):
        with np.errstate(invalid="ignore"):
            ragged = segments > max(RAGGED_RATIO * overall, LEAST_RAGGED_PX)
        for i, j in np.argwhere(ragged):
            row, col = (i, j + 0.5) if index == 0 else (i + 0.5, j)
            centre = seen.lattice.at(np.array([row]), np.array([col]))[0, 0] + first
            strength = float(segments[i, j])
            found.append(
                Defect(
                    DefectKind.RAGGED_EDGE, float(row), float(col), centre, seen.side_px, strength
                )
            )
    return found
