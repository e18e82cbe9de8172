"""Renders the deformed pattern as the camera sees it, without what light and camera add."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from cmp_tactile_processing.elastic.elastomer_mesh import BlockGeometry
from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.rendering.deformed_surface import DeformedSurface
from cmp_tactile_simulation.rendering.ink import HOUSING_GREY, Ink
from cmp_tactile_simulation.rendering.ink_kernel import InkArrays
from cmp_tactile_simulation.rendering.pixel_rays import PixelRays
from cmp_tactile_simulation.rendering.shading import Picture, shade, solve
from cmp_tactile_simulation.rendering.surface_mesh import SurfaceMesh
from cmp_tactile_simulation.rendering.surface_spline import SplineSurface

__all__ = ["RenderedFrame", "Renderer"]

MAX_SAMPLES = 32
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


@dataclass(frozen=True)
class _View:
    """What stays the same from frame to frame, and the arrays that are filled anew."""

    geometry: ViewGeometry
    mesh: SurfaceMesh
    picture: Picture

    @classmethod
    def from_geometry(
        cls, geometry: ViewGeometry, rest: SplineSurface, samples: int, fineness: int
    ) -> _View:
        mesh, rays = SurfaceMesh.from_view(geometry, rest), PixelRays.from_view(geometry)
        shape = rays.directions.shape[:2]
        picture = Picture(
            points=np.empty((*shape, 4)),
            state=np.empty(shape, np.uint8),
            origins=rays.origins,
            directions=rays.directions,
            pixel_m=mesh.pixel_m,
            samples=samples,
            fineness=fineness,
        )
        return cls(geometry, mesh, picture)


class Renderer:
    """Renders frames of one sensor; each pixel is the mean of samples x samples points.

    A pixel's rays go through the view's lens, mirror and refracting layers and meet the deformed
    surface exactly, so that the picture shows the pattern where ViewGeometry.project says.
    Not for use by several threads at once.  threads: default that of numba; the picture does not
    depend on it.  Raises GeometryError for a sensor without a block and ParameterError for
    samples outside 1..32.
    """

    def __init__(
        self, sensor: SensorDescription, ink: Ink, samples: int = 4, threads: int | None = None
    ) -> None:
        if not 1 <= samples <= MAX_SAMPLES:
            msg = f"samples: found {samples}, expected 1 to {MAX_SAMPLES}"
            raise ParameterError(msg)
        self._sensor = sensor
        self._size = size = BlockGeometry.from_sensor(sensor).size[:2]
        plain, strays, blobs = ink.arrays
        plain = plain._replace(half_x=size[0] / 2, half_y=size[1] / 2, housing=HOUSING_GREY)
        self._ink = InkArrays(plain, strays, blobs)
        rest = DeformedSurface.rest(sensor.pattern).spline(self._size)
        # Lenses blur before pixels integrate: a frame of whole pixels would be blurred too late.
        self._fineness = 1 if samples % 2 else 2
        self._views = [
            _View.from_geometry(view, rest, samples, self._fineness)
            for view in build_views(sensor).values()
        ]
        self._threads = threads or get_num_threads()
        self._pool = ThreadPoolExecutor(self._threads)

    def render(self, surface: DeformedSurface) -> RenderedFrame:
        """The frame in even light, without blur and noise; `expose` makes a camera's of it."""
        image, fine = self._sensor.image, self._fineness
        grey = np.full((image.height * fine, image.width * fine), HOUSING_GREY, dtype=np.float32)
        spline = surface.spline(self._size)
        seen = [view.mesh.project(spline) for view in self._views]

        def guess(index: int, rows: tuple[int, int]) -> None:
            view = self._views[index]
            view.mesh.guesses(seen[index], rows, view.picture.points)
            solve(spline, self._ink, view.picture, rows)

        def fill(index: int, rows: tuple[int, int]) -> None:
            view = self._views[index]
            shade(spline, self._ink, view.picture, rows, self._part(grey, view))

        self._in_bands(guess, border=2)
        self._in_bands(fill, border=0)
        return RenderedFrame(grey, fine)

    def _part(self, grey: NDArray[np.float32], view: _View) -> NDArray[np.float32]:
        """The view's part of the frame, un-mirrored."""
        place, fine = view.geometry.placement, self._fineness
        rows = slice(place.y * fine, (place.y + place.height) * fine)
        part = grey[rows, place.x * fine : (place.x + place.width) * fine]
        return part[:, ::-1] if place.flipped else part

    def _in_bands(self, work: Callable[[int, tuple[int, int]], None], border: int) -> None:
        """Do the work for all views, band of rows by band of rows."""
        bands = []
        for index, view in enumerate(self._views):
            height = view.geometry.placement.height + border
            edges = np.linspace(0, height, BANDS_PER_THREAD * self._threads + 1).astype(int)
            bands += [(index, (int(first), int(last))) for first, last in itertools.pairwise(edges)]
        # list() waits for all and raises what one of them raised.
        list(self._pool.map(lambda band: work(*band), bands))
