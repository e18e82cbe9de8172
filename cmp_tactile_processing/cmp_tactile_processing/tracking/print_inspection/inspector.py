"""Inspection of a print at rest: missing ink, dirt, ragged edges, and what that makes doubtful."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ReferenceFramesError
from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.measured.grid import Grid, GridShape
from cmp_tactile_processing.tracking.print_inspection.defects import (
    Defect,
    DefectKind,
    PrintDefects,
)
from cmp_tactile_processing.tracking.print_inspection.edges import LineScatter, overall_raggedness
from cmp_tactile_processing.tracking.print_inspection.frames import MeanFrame
from cmp_tactile_processing.tracking.print_inspection.lattice import PrintPlaces
from cmp_tactile_processing.tracking.print_inspection.spots import Spot
from cmp_tactile_processing.tracking.print_inspection.view import (
    PrintView,
    sampled,
    side_of_checkers,
)

__all__ = ["PrintInspection"]

# A segment is a defect of its own where it strays so many times as far as the others and so far,
# seen in so many markers.
RAGGED_RATIO, LEAST_RAGGED_PX, LEAST_MARKERS = 2.5, 0.3, 3


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

        Raises ReferenceFramesError where half of the corners are missing or the gel has moved since
        the first frame, and GeometryError for a grid or an image of another size.
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


def _judged(frame: MeanFrame) -> PrintDefects:
    corners = frame.corners
    if np.isnan(corners).all():
        return _unjudged(frame)
    side = side_of_checkers(corners)
    low = np.maximum(np.floor(np.nanmin(corners, axis=(0, 1)) - 1.5 * side), 0).astype(int)
    high = np.ceil(np.nanmax(corners, axis=(0, 1)) + 1.5 * side).astype(int) + 1
    part = np.ascontiguousarray(frame.image[low[1] : high[1], low[0] : high[0]])
    seen = PrintView.in_image(part, frame.noise, corners - low)
    if seen is None:
        return _unjudged(frame)
    first = frame.origin + low
    scatters = []
    for index in range(2):
        lines, std = frame.line(index)
        scatters.append(seen.scatter(lines - low, std, along_rows=index == 0))
    spots = [_spot(spot, seen.places, first) for spot in seen.spots.spots]
    return PrintDefects(
        corner_weight=seen.corner_weight(),
        row_line_doubtful=scatters[0].doubtful,
        col_line_doubtful=scatters[1].doubtful,
        row_raggedness=scatters[0].raggedness,
        col_raggedness=scatters[1].raggedness,
        raggedness_px=overall_raggedness(scatters),
        defects=(*spots, *_ragged_edges(scatters, seen, first)),
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
            ragged = scatter.raggedness > max(RAGGED_RATIO * usual, LEAST_RAGGED_PX)
        for i, j in np.argwhere(ragged & (scatter.count >= LEAST_MARKERS)):
            row, col = i + down, j + right
            centre = seen.lattice.at(np.array([row]), np.array([col]))[0, 0] + first
            strength = float(scatter.raggedness[i, j])
            place = float(row), float(col), centre
            found.append(Defect(DefectKind.RAGGED_EDGE, *place, seen.side_px, strength))
    return found
