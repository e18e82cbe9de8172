"""The pattern at rest as one view shows it: what the numbering is anchored to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.geometry.optics import ViewGeometry
from cmp_tactile_processing.sensor.pattern import Pattern

__all__ = ["ImageWindow", "NominalAxes", "NominalGrid"]

# The pattern is looked for this many sides around its nominal place: the largest displacement
# that is expected, and the outermost checkers.
SEARCH_MARGIN = 5.0
# Smaller checkers than these cannot be told apart.
SMALLEST_SIDE_PX = 3.0


@dataclass(frozen=True)
class ImageWindow:
    """The part of a view image in which the pattern is looked for, px."""

    x: int
    y: int
    width: int
    height: int

    @property
    def origin(self) -> NDArray[np.float64]:
        """The window's top-left pixel in the view, (2,) px."""
        return np.array([self.x, self.y], dtype=np.float64)

    def cut(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """That part of an image, as a view of it."""
        return image[self.y : self.y + self.height, self.x : self.x + self.width]


@dataclass(frozen=True)
class NominalGrid:
    """Nominal projection of the corners into one view.

    corners (rows, cols, 2) px; row_step, col_step (rows, cols, 2): px from a corner to the next
    along i and along j; side_px: median side of a checker; tree: nearest nominal corner.
    """

    corners: NDArray[np.float64]
    row_step: NDArray[np.float64]
    col_step: NDArray[np.float64]
    side_px: float
    smallest_side_px: float
    largest_side_px: float
    tree: cKDTree

    @classmethod
    def of_view(cls, pattern: Pattern, view: ViewGeometry) -> NominalGrid:
        """The nominal grid of a pattern at rest.

        Raises GeometryError where its checkers are too small to be told apart.
        """
        corners = view.project(pattern.corners())
        row_step = np.gradient(corners, axis=0)
        col_step = np.gradient(corners, axis=1)
        sides = np.concatenate(
            [np.linalg.norm(step, axis=-1).ravel() for step in (row_step, col_step)]
        )
        if not sides.min() >= SMALLEST_SIDE_PX:
            msg = (
                f"{view.name} view: found checkers of {sides.min():.2g} px, expected at least "
                f"{SMALLEST_SIDE_PX:g} px; check pattern.pitch ({pattern.pitch:g} m) and the camera"
            )
            raise GeometryError(msg)
        return cls(
            corners=corners,
            row_step=row_step,
            col_step=col_step,
            side_px=float(np.median(sides)),
            smallest_side_px=float(sides.min()),
            largest_side_px=float(sides.max()),
            tree=cKDTree(corners.reshape(-1, 2)),
        )

    def window(self, width: int, height: int) -> ImageWindow:
        """The part of a width x height image around the pattern, with room for displacement."""
        margin = SEARCH_MARGIN * self.largest_side_px
        flat = self.corners.reshape(-1, 2)
        limit = np.array([width, height])
        low = np.clip(np.floor(flat.min(axis=0) - margin), 0, limit - 1).astype(int)
        high = np.clip(np.ceil(flat.max(axis=0) + margin), low + 1, limit).astype(int)
        return ImageWindow(int(low[0]), int(low[1]), *(int(side) for side in high - low))

    def seen_through(self, window: ImageWindow) -> NominalGrid:
        """The same grid in pixels of the window."""
        corners = self.corners - window.origin
        return replace(self, corners=corners, tree=cKDTree(corners.reshape(-1, 2)))

    def magnified(self, factor: int) -> NominalGrid:
        """The same grid in pixels of the image magnified by a whole number."""
        corners = (self.corners + 0.5) * factor - 0.5
        return NominalGrid(
            corners=corners,
            row_step=self.row_step * factor,
            col_step=self.col_step * factor,
            side_px=self.side_px * factor,
            smallest_side_px=self.smallest_side_px * factor,
            largest_side_px=self.largest_side_px * factor,
            tree=cKDTree(corners.reshape(-1, 2)),
        )

    def axes_near(self, q: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Steps along i and along j, (N, 2) px each, of the nominal corner nearest to q (N, 2)."""
        nearest = self.tree.query(q)[1]
        return self.row_step.reshape(-1, 2)[nearest], self.col_step.reshape(-1, 2)[nearest]


class NominalAxes:
    """Steps of the nominal corner near a point, from a raster: what `axes_near` tells, at once.

    nominal: in pixels of the window in which the points lie.
    """

    def __init__(self, nominal: NominalGrid) -> None:
        self._cell = nominal.smallest_side_px / 2
        flat = nominal.corners.reshape(-1, 2)
        self._low = flat.min(axis=0) - self._cell
        size = np.ceil((flat.max(axis=0) + self._cell - self._low) / self._cell).astype(np.intp)
        self._last = np.maximum(size, 1) - 1
        x, y = (np.arange(last + 1) + 0.5 for last in self._last)
        centres = self._low + self._cell * np.stack(np.meshgrid(x, y), axis=-1)
        row_step, col_step = nominal.axes_near(centres.reshape(-1, 2))
        self._steps = np.concatenate([row_step, col_step], axis=1).reshape(len(y), len(x), 4)

    def near(self, q: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Steps along i and along j, (N, 2) px each, near q (N, 2); beyond the grid its rim's."""
        place = np.clip((q - self._low) / self._cell, 0, self._last).astype(np.intp)
        steps = self._steps[place[:, 1], place[:, 0]]
        return steps[:, :2], steps[:, 2:]
