"""What a detector gets and what it finds: the nominal grid, and corners joined by gridlines."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.optics import ViewGeometry
from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.sensor.dot_code import DOT_DIAMETER
from cmp_tactile_processing.sensor.parts import Pattern

# Pointers towards i-1, j+1, i+1, j-1 as steps in (i, j).
STEPS = np.array([[-1, 0], [0, 1], [1, 0], [0, -1]])

# The pattern is looked for this many sides around its nominal place: the largest displacement
# that is expected, and the outermost checkers.
SEARCH_MARGIN = 5.0
# Smaller checkers than these cannot be distinguished.
SMALLEST_SIDE_PX = 3.0
# Nor smaller ones with dots.
SMALLEST_CODED_SIDE_PX = 6.5

DARK, LIGHT = 50, 190
# Places are drawn to so many binary digits of a pixel.
SHIFT = 4


@dataclass(frozen=True)
class CornerGraph:
    """Corners of the pattern with pointers to their neighbours along the gridlines.

    position (n, 2) px; merged (n,) bool: an inner corner, shared by two checkers;
    even (n,) bool: the dark checkers touch it along the diagonal (-, -) to (+, +);
    neighbour (n, 4): index of the next corner towards i-1, j+1, i+1, j-1, or -1.
    """

    position: NDArray[np.float64]
    merged: NDArray[np.bool_]
    even: NDArray[np.bool_]
    neighbour: NDArray[np.intp]


@dataclass(frozen=True)
class Component:
    """Connected inner corners: position (n, 2) px, number (n, 2) from an unknown origin, even."""

    position: NDArray[np.float64]
    number: NDArray[np.intp]
    even: NDArray[np.bool_]

    def lattice(self) -> tuple[NDArray[np.float64], bool]:
        """Positions by number from (0, 0), (R, C, 2) px, NaN where none; whether (0, 0) is even."""
        number = self.number - self.number.min(axis=0)
        lattice = np.full((*(number.max(axis=0) + 1), 2), np.nan)
        lattice[number[:, 0], number[:, 1]] = self.position
        return lattice, bool(self.even[0]) == (int(number[0].sum()) % 2 == 0)


class GridlineDetector(Protocol):
    """Finds the corners in an image and how gridlines connect them, knowing no earlier frame."""

    def corner_graph(self, image: PreparedImage) -> CornerGraph:
        """Corners, to a pixel or two, in pixels of the prepared image; may be empty."""


# The pattern at rest as one view shows it: what the numbering is anchored to.


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

        Raises InputError where its checkers are too small to be distinguished.
        """
        corners = view.project(pattern.corners())
        row_step = np.gradient(corners, axis=0)
        col_step = np.gradient(corners, axis=1)
        sides = np.concatenate(
            [np.linalg.norm(step, axis=-1).ravel() for step in (row_step, col_step)]
        )
        least = SMALLEST_SIDE_PX if pattern.code == "none" else SMALLEST_CODED_SIDE_PX
        if not sides.min() >= least:
            coded = "" if pattern.code == "none" else f" with code: {pattern.code}"
            msg = (
                f"{view.name} view: found checkers of {sides.min():.2g} px, expected at least "
                f"{least:g} px{coded}; check pattern.pitch ({pattern.pitch:g} m) and the camera"
            )
            raise InputError(msg)
        return cls(
            corners=corners,
            row_step=row_step,
            col_step=col_step,
            side_px=float(np.median(sides)),
            smallest_side_px=float(sides.min()),
            largest_side_px=float(sides.max()),
            tree=cKDTree(corners.reshape(-1, 2)),
        )

    def with_surroundings(self, pattern: Pattern, view: ViewGeometry) -> NominalGrid:
        """The grid of a pattern that goes on beyond the view, with what the view shows around it.

        It ends where checkers are too small or beyond what the lens shows.
        """
        if pattern.border == "in_view":
            return self
        place = view.placement
        along = np.sqrt(place.width * place.height) / self.smallest_side_px
        for more in range(int(along - min(pattern.rows, pattern.cols)) // 2, 0, -1):
            rows, cols = pattern.rows + 2 * more, pattern.cols + 2 * more
            with suppress(InputError):
                return self.of_view(replace(pattern, rows=rows, cols=cols, code="none"), view)
        return self

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
    """Steps of the nominal corner near a point: `axes_near` from a raster, without a search.

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


# A plain drawing of the pattern at rest, as one view would show it.


def draw_nominal(
    nominal: NominalGrid,
    shape: tuple[int, int],
    dark_first: bool,
    dots: NDArray[np.bool_] | None = None,
) -> NDArray[np.uint8]:
    """Picture (height, width) uint8 of the nominal grid on a light or dark margin, without shading.

    dark_first: whether the checker outside corner (0, 0) is dark; the margin is of the other kind.
    dots (rows + 1, cols + 1): checkers that bear one; None where none does.
    """
    ring = np.pad(nominal.corners, ((1, 1), (1, 1), (0, 0)), mode="reflect", reflect_type="odd")
    ground, ink = (LIGHT, DARK) if dark_first else (DARK, LIGHT)
    picture = np.full(shape, ground, dtype=np.uint8)
    rows, cols = ring.shape[:2]
    for i in range(rows - 1):
        for j in range(i % 2, cols - 1, 2):
            outline = ring[[i, i, i + 1, i + 1], [j, j + 1, j + 1, j]]
            fixed = np.rint(outline * 2**SHIFT).astype(np.int32)
            cv2.fillConvexPoly(picture, fixed, ink, cv2.LINE_AA, SHIFT)
    radius = round(DOT_DIAMETER / 2 * nominal.side_px * 2**SHIFT)
    for i, j in np.argwhere(dots) if dots is not None else ():
        x, y = np.rint(ring[i : i + 2, j : j + 2].mean(axis=(0, 1)) * 2**SHIFT).astype(int)
        grey = ground if (i + j) % 2 == 0 else ink
        cv2.circle(picture, (int(x), int(y)), radius, grey, cv2.FILLED, cv2.LINE_AA, SHIFT)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.8), dtype=np.uint8)


def spoilt_pictures(picture: NDArray[np.uint8], nominal: NominalGrid) -> list[NDArray[np.uint8]]:
    """The picture with spots and salt, with parts hidden, with a board over it, and mirrored."""
    rows, cols = nominal.corners.shape[:2]
    across, down = nominal.corners[rows // 2, cols // 2].astype(int)
    spotted = picture.copy()
    x, y = np.rint(nominal.corners[1, 1]).astype(int)
    spotted[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3] = LIGHT
    spotted[::7, ::7] = 0
    covered, components, board = picture.copy(), picture.copy(), picture.copy()
    covered[:, across:] = (DARK + LIGHT) // 2
    width = max(int(2 * nominal.side_px), 1)
    components[max(down - width, 0) : down + width] = (DARK + LIGHT) // 2
    board[:, across:] = np.roll(picture, int(nominal.side_px) // 2, axis=0)[:, across:]
    return [spotted, covered, components, board, picture[::-1], picture[:, ::-1]]
