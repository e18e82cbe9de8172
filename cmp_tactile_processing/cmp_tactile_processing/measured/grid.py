"""The gridlines of one view: measured markers, virtual markers, their status."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError

__all__ = ["Grid", "GridFault", "GridShape", "Status", "ViewPlacement"]


class Status(IntEnum):
    """What a marker's coordinates rest on."""

    MISSING = 0
    MEASURED = 1
    PREDICTED = 2


class GridFault(str, Enum):
    """Why corners are missing, by name; `Grid.reason` says it in words."""

    NONE = ""
    DARK = "dark"
    OVEREXPOSED = "overexposed"
    NO_CONTRAST = "no_contrast"
    NO_PATTERN = "no_pattern"
    OTHER_SIZE = "other_size"
    MIRRORED = "mirrored"
    TURNED = "turned"
    OTHER_COLOURS = "other_colours"
    TWO_PATTERNS = "two_patterns"
    AMBIGUOUS = "ambiguous"
    PARTLY_HIDDEN = "partly_hidden"


@dataclass(frozen=True)
class GridShape:
    """Number of corners along y (rows) and x (cols), and of virtual markers per segment."""

    rows: int
    cols: int
    points_per_segment: int

    @property
    def corners(self) -> tuple[int, int]:
        """Shape of an array with one entry per corner."""
        return self.rows, self.cols

    @property
    def row_lines(self) -> tuple[int, int, int]:
        """Shape of an array with one entry per virtual marker along the rows."""
        return self.rows, self.cols - 1, self.points_per_segment

    @property
    def col_lines(self) -> tuple[int, int, int]:
        """Shape of an array with one entry per virtual marker along the columns."""
        return self.rows - 1, self.cols, self.points_per_segment


@dataclass(frozen=True)
class ViewPlacement:
    """Where a published view lies in the camera frame.

    The view is cut out at (x, y) and, when `flipped`, mirrored left to right: this is the one
    place where the handedness of a mirror's image is put right.
    """

    x: int
    y: int
    width: int
    height: int
    flipped: bool

    def to_frame(self, q_view: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels of the whole frame for pixels of the view, (..., 2) -> (..., 2)."""
        q_frame = np.array(q_view, dtype=np.float64)
        if self.flipped:
            q_frame[..., 0] = self.width - 1 - q_frame[..., 0]
        return q_frame + (self.x, self.y)

    def from_frame(self, q_frame: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels of the view for pixels of the whole frame, (..., 2) -> (..., 2)."""
        q_view = np.asarray(q_frame, dtype=np.float64) - (self.x, self.y)
        if self.flipped:
            q_view[..., 0] = self.width - 1 - q_view[..., 0]
        return q_view


@dataclass(frozen=True)
class Grid:
    """Gridlines of one view in one frame; missing points are NaN with status 0.

    corners (rows, cols, 2) px in the view image as published; corner_status (rows, cols).
    row_lines (rows, cols-1, n, 2) px, [i, j, k] from corner (i, j) towards (i, j+1);
    col_lines (rows-1, cols, n, 2) px, from corner (i, j) towards (i+1, j); their status.
    residual_px: RMS distance of the measured corners from the curves through their neighbours.
    fault, reason: why corners are missing, by name and in words; empty when none is.
    corner_std (rows, cols), row_line_std, col_line_std: standard deviation of each point, px, of a
    corner per coordinate, of a virtual marker across its gridline; NaN where it is not known.
    confidence: 0 to 1, how surely the corners bear their right numbers; a followed grid has that of
    the detection that it goes back to.
    followed: whether the corners were looked for where the last frame had them.
    placement: the view's place in the frame, None for a grid that came without it.
    """

    shape: GridShape
    corners: NDArray[np.float64]
    corner_status: NDArray[np.uint8]
    row_lines: NDArray[np.float64]
    row_line_status: NDArray[np.uint8]
    col_lines: NDArray[np.float64]
    col_line_status: NDArray[np.uint8]
    residual_px: float = float("nan")
    reason: str = ""
    placement: ViewPlacement | None = None
    fault: GridFault = GridFault.NONE
    corner_std: NDArray[np.float64] | None = None
    row_line_std: NDArray[np.float64] | None = None
    col_line_std: NDArray[np.float64] | None = None
    confidence: float = float("nan")
    followed: bool = False

    @classmethod
    def missing(
        cls,
        shape: GridShape,
        reason: str,
        placement: ViewPlacement | None = None,
        fault: GridFault = GridFault.NO_PATTERN,
    ) -> Grid:
        """A grid of which nothing was seen."""
        return cls(
            shape=shape,
            corners=np.full((*shape.corners, 2), np.nan),
            corner_status=np.zeros(shape.corners, np.uint8),
            row_lines=np.full((*shape.row_lines, 2), np.nan),
            row_line_status=np.zeros(shape.row_lines, np.uint8),
            col_lines=np.full((*shape.col_lines, 2), np.nan),
            col_line_status=np.zeros(shape.col_lines, np.uint8),
            reason=reason,
            placement=placement,
            fault=fault,
            corner_std=np.full(shape.corners, np.nan),
            row_line_std=np.full(shape.row_lines, np.nan),
            col_line_std=np.full(shape.col_lines, np.nan),
            confidence=0.0,
        )

    @property
    def found_fraction(self) -> float:
        """Share of the corners that were measured, 0 to 1."""
        return float(np.mean(self.corner_status == Status.MEASURED))

    @property
    def corners_frame(self) -> NDArray[np.float64]:
        """`corners` in pixels of the whole camera frame."""
        return self._placement().to_frame(self.corners)

    @property
    def row_lines_frame(self) -> NDArray[np.float64]:
        """`row_lines` in pixels of the whole camera frame."""
        return self._placement().to_frame(self.row_lines)

    @property
    def col_lines_frame(self) -> NDArray[np.float64]:
        """`col_lines` in pixels of the whole camera frame."""
        return self._placement().to_frame(self.col_lines)

    def _placement(self) -> ViewPlacement:
        if self.placement is None:
            msg = "this grid does not know where its view lies in the frame"
            raise GeometryError(msg)
        return self.placement
