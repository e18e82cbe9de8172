"""Renders the deformed pattern as the camera sees it, without what light and camera add.

What is true of a rendered frame is known with it: where its corners and gridline points are.
"""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from cmp_tactile_processing.measured import Grid, GridFault, GridShape, Status, Surface
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.rendering.ink import HOUSING_GREY, Checkerboard, Dots, InkArrays
from cmp_tactile_simulation.rendering.shading import Picture, cast, shade
from cmp_tactile_simulation.rendering.sight import NODE_PX, SensorViews, Sight
from cmp_tactile_simulation.rendering.surface import DeformedSurface

BANDS_PER_THREAD = 4


@dataclass(frozen=True)
class RenderedFrame:
    """A frame without light and camera: dark ink 45, light skin 205, housing 18 of 255.

    grey (height * fineness, width * fineness): each pixel of the camera is fineness^2 entries.
    """

    grey: NDArray[np.float32]
    fineness: int

    @property
    def pixels(self) -> NDArray[np.float32]:
        """The mean over each pixel, (height, width)."""
        if self.fineness == 1:
            return self.grey
        rows, cols = (side // self.fineness for side in self.grey.shape)
        parts = self.grey.reshape(rows, self.fineness, cols, self.fineness)
        return np.asarray(parts.mean(axis=(1, 3)))


class Renderer:
    """Renders frames of one sensor; each pixel is the mean of samples x samples points.

    A pixel's rays go through the view's lens, mirror and refracting layers and meet the deformed
    surface exactly, so that the picture shows the pattern where ViewGeometry.project says.
    Not for use by several threads at once.  threads: default that of numba; the picture does not
    depend on it.  Raises InputError for a sensor without a block.
    """

    def __init__(
        self,
        sensor: SensorDescription,
        ink: Checkerboard | Dots,
        samples: int = 4,
        threads: int | None = None,
    ) -> None:
        self._image, self._samples = sensor.image, samples
        self.views = SensorViews(sensor)
        self.use(ink)
        # Lenses blur before pixels integrate: a frame of whole pixels would be blurred too late.
        self._fineness = 1 if samples % 2 else 2
        self._threads = threads or get_num_threads()
        self._pool = ThreadPoolExecutor(self._threads)

    def use(self, ink: Checkerboard | Dots) -> None:
        """Render this print from now on."""
        plain, strays, blobs = ink.arrays
        half_x, half_y = self.views.size[0] / 2, self.views.size[1] / 2
        plain = plain._replace(half_x=half_x, half_y=half_y, housing=HOUSING_GREY)
        self._ink = InkArrays(plain, strays, blobs)

    def render(self, surface: DeformedSurface) -> RenderedFrame:
        """The frame in even light, without blur and noise; `expose` makes a camera's of it."""
        image, fine = self._image, self._fineness
        grey = np.full((image.height * fine, image.width * fine), HOUSING_GREY, dtype=np.float32)
        works = []
        for sight in self.views.see(surface):
            edges = np.linspace(0, len(sight.folded), BANDS_PER_THREAD * self._threads + 1)
            bands = itertools.pairwise(edges.astype(int).tolist())
            works += [self._pool.submit(self._fill, sight, rows, grey) for rows in bands]
        for work in works:
            work.result()
        return RenderedFrame(grey, fine)

    def _fill(self, sight: Sight, rows: tuple[int, int], frame: NDArray[np.float32]) -> None:
        """Fill these rows of cells of a view's part of the frame."""
        view, place, fine = sight.at, sight.at.view.placement, self._fineness
        picture = Picture(
            nodes=sight.nodes,
            folded=sight.folded,
            origins=view.origins,
            directions=view.directions,
            pixel_m=view.pixel_m,
            samples=self._samples,
            fineness=fine,
            height=place.height,
            width=place.width,
            top=place.y * fine,
            left=(place.x + place.width) * fine - 1 if place.flipped else place.x * fine,
            step=-1 if place.flipped else 1,
        )
        left = shade(sight.surface, self._ink, picture, rows, frame)
        if len(left):
            pixels = NODE_PX * rows[0], min(NODE_PX * rows[1], place.height)
            guesses = sight.guesses(pixels), pixels[0]
            cast(sight.surface, self._ink, picture, left, guesses, frame)


class OpticalTruth:
    """What is true of the frames of one sensor.  Raises InputError for one without a block.

    views: of that sensor, such as a renderer's: what they see is looked for once.
    """

    def __init__(self, sensor: SensorDescription, views: SensorViews | None = None) -> None:
        self._pattern, self._views = sensor.pattern, views or SensorViews(sensor)
        self._numbers = _marker_numbers(sensor.pattern.shape)

    def grids(self, surface: DeformedSurface) -> dict[str, Grid]:
        """Exact gridlines of each view, px of the view, with its placement.

        Virtual markers divide a segment into equal parts of the undeformed pattern.  Points
        outside the view's part of the frame, and those that the surface itself hides, are missing.
        """
        markers, grids = [surface.material(i, j) for i, j in self._numbers], {}
        for sight in self._views.see(surface):
            corners, row_lines, col_lines = (sight.pixels(material) for material in markers)
            reason = _reason(corners)
            grids[sight.at.view.name] = Grid(
                shape=self._pattern.shape,
                corners=corners,
                corner_status=_status(corners),
                row_lines=row_lines,
                row_line_status=_status(row_lines),
                col_lines=col_lines,
                col_line_status=_status(col_lines),
                residual_px=0.0,
                reason=reason,
                placement=sight.at.view.placement,
                fault=GridFault.PARTLY_HIDDEN if reason else GridFault.NONE,
                confidence=1.0,
            )
        return grids

    def surface(self, surface: DeformedSurface) -> Surface:
        """The markers in 3-D, gel frame, m; displacement is relative to the nominal surface."""
        shape, reference = self._pattern.shape, self._pattern.corners()
        corners, row_lines, col_lines = (surface.at(i, j) for i, j in self._numbers)
        return Surface.from_exact_points(shape, reference, corners, row_lines, col_lines)


def true_grids(sensor: SensorDescription, surface: DeformedSurface) -> dict[str, Grid]:
    """The grids of a single surface; OpticalTruth for many of one sensor."""
    return OpticalTruth(sensor).grids(surface)


def _marker_numbers(shape: GridShape) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Fractional rows and columns of corners, points on row lines, points on column lines."""
    rows, cols = np.arange(shape.rows), np.arange(shape.cols)
    part = np.arange(1, shape.points_per_segment + 1) / (shape.points_per_segment + 1)
    return [
        (rows[:, None] + np.zeros(shape.corners), cols + np.zeros(shape.corners)),
        (
            rows[:, None, None] + np.zeros(shape.row_lines),
            cols[:-1, None] + part + np.zeros(shape.row_lines),
        ),
        (
            rows[:-1, None, None] + part + np.zeros(shape.col_lines),
            cols[:, None] + np.zeros(shape.col_lines),
        ),
    ]


def _status(points: NDArray[np.float64]) -> NDArray[np.uint8]:
    seen = np.isfinite(points[..., 0])
    return np.where(seen, Status.MEASURED, Status.MISSING).astype(np.uint8)


def _reason(corners: NDArray[np.float64]) -> str:
    missing = int(np.isnan(corners[..., 0]).sum())
    return f"{missing} corners hidden or outside the view" if missing else ""
