"""The mean of several frames of one print at rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError, ReferenceFramesError
from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.measured.grid import Grid, GridShape, Status

__all__ = ["MeanFrame"]

# Frames in which the corners lie farther apart than this, in the median, are not of one rest, px.
SAME_REST_PX = 0.5
# What shows less of the pattern tells nothing of the print.
LEAST_SEEN = 0.5
# Rounding to whole grey levels is noise, too.
ROUNDING_NOISE = 12**-0.5


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
        self._sum = np.zeros(size, dtype=np.float32)
        self.frames = 0
        self.origin = np.zeros(2)
        self._noise2 = 0.0
        self._first: NDArray[np.float64] | None = None
        self._corners = _Mean((*shape.corners, 2))
        self._lines = [_Mean((*lines, 2)) for lines in (shape.row_lines, shape.col_lines)]
        self._variances = [_Mean((*lines, 1)) for lines in (shape.row_lines, shape.col_lines)]

    def add(self, image: PreparedImage, grid: Grid, origin: tuple[float, float]) -> None:
        """Take in a frame; raises as `PrintInspection.add` does."""
        if grid.shape != self.shape:
            msg = f"print inspection: found a grid of {grid.shape}, expected {self.shape}"
            raise GeometryError(msg)
        if image.grey.shape != self._sum.shape:
            msg = f"print inspection: found an image of {image.grey.shape}, expected "
            raise GeometryError(f"{msg}{self._sum.shape}")
        corners = np.where((grid.corner_status == Status.MEASURED)[..., None], grid.corners, np.nan)
        self._check_rest(corners, origin)
        self._sum += image.grey
        self._noise2 += image.noise**2 + ROUNDING_NOISE**2
        self.frames += 1
        self._corners.add(corners - self.origin, np.isfinite(corners[..., 0]))
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
            raise ReferenceFramesError(msg)
        if self._first is None:
            self._first, self.origin = corners, np.array(origin, dtype=np.float64)
            return
        moved = np.linalg.norm(corners - self._first, axis=-1)
        moved = moved[np.isfinite(moved)]
        shift = float(np.median(moved)) if len(moved) else 0.0
        if shift > SAME_REST_PX or tuple(self.origin) != tuple(origin):
            msg = (
                f"print inspection: found the gel {shift:.2f} px from where the first frame had "
                f"it, expected less than {SAME_REST_PX} px: the frames must be of one rest"
            )
            raise ReferenceFramesError(msg)

    @property
    def image(self) -> NDArray[np.float32]:
        """The mean image (H, W)."""
        return np.asarray(self._sum / np.float32(self.frames), dtype=np.float32)

    @property
    def noise(self) -> float:
        """Standard deviation of the mean image's noise, grey levels."""
        return float(np.sqrt(self._noise2) / self.frames)

    @property
    def corners(self) -> NDArray[np.float64]:
        """Mean corners (rows, cols, 2), NaN where never measured."""
        return self._corners.value

    def line(self, index: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean markers (a, b, n, 2) along rows (0) or columns (1) and their std, NaN if unknown."""
        std = np.sqrt(self._variances[index].value[..., 0] / self.frames)
        return self._lines[index].value, std
