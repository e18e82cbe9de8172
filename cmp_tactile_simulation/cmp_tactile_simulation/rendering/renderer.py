"""Renders the deformed pattern as the camera sees it, without what light and camera add.

What is true of a rendered frame is known with it: where its corners and gridline points are.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.elastic.mesh import BlockGeometry
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.measured import Grid, GridFault, GridShape, Status, Surface
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.rendering.ink import HOUSING_GREY, Checkerboard, Dots, InkArrays
from cmp_tactile_simulation.rendering.shading import ALIKE_PIXELS, Picture, shade, solve
from cmp_tactile_simulation.rendering.surface import (
    DeformedSurface,
    SplineSurface,
    first_meetings,
    surface_points,
)

BANDS_PER_THREAD = 4

# Pixels around the view that have rays too: what happens between two pixels depends on a third.
BORDER = 1

# Sides of the mesh's cells in the picture, px, and their number along the block.
CELL_PX = 8.0
FEWEST_CELLS, MOST_CELLS = 80, 300
# The mesh reaches so many pixels beyond the block, so that its edge lies between mesh points.
BEYOND_PX = 4.0
# A point that its own pixel's ray misses by more than this, m, is outside what the lens shows.
LENS_TOLERANCE_M = 1e-4

# A marker is hidden where its ray first meets the surface further than this from it, m.
SAME_POINT_M = 1e-7


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
    """What stays the same from frame to frame, and the arrays that are filled again."""

    geometry: ViewGeometry
    mesh: SurfaceMesh
    picture: Picture

    @classmethod
    def from_geometry(
        cls, geometry: ViewGeometry, rest: SplineSurface, samples: int, fineness: int
    ) -> _View:
        mesh, (origins, directions) = SurfaceMesh.from_view(geometry, rest), pixel_rays(geometry)
        shape = directions.shape[:2]
        picture = Picture(
            points=np.empty((*shape, 4)),
            state=np.empty(shape, np.uint8),
            origins=origins,
            directions=directions,
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
    depend on it.  Raises InputError for a sensor without a block.
    """

    def __init__(
        self,
        sensor: SensorDescription,
        ink: Checkerboard | Dots,
        samples: int = 4,
        threads: int | None = None,
    ) -> None:
        self._sensor = sensor
        self._size = BlockGeometry.from_sensor(sensor).size[:2]
        self.use(ink)
        rest = DeformedSurface.rest(sensor.pattern).spline(self._size)
        # Lenses blur before pixels integrate: a frame of whole pixels would be blurred too late.
        self._fineness = 1 if samples % 2 else 2
        self._views = [
            _View.from_geometry(view, rest, samples, self._fineness)
            for view in build_views(sensor).values()
        ]
        self._threads = threads or get_num_threads()
        self._pool = ThreadPoolExecutor(self._threads)

    def use(self, ink: Checkerboard | Dots) -> None:
        """Render this print from now on."""
        plain, strays, blobs = ink.arrays
        half_x, half_y = self._size[0] / 2, self._size[1] / 2
        plain = plain._replace(half_x=half_x, half_y=half_y, housing=HOUSING_GREY)
        self._ink = InkArrays(plain, strays, blobs)

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


def pixel_rays(view: ViewGeometry) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays inside the gel of a view's pixels and of one more all around, gel frame.

    Returns
    -------
    origins: (height + 2, width + 2, 3) m, or (1, 1, 3) where all rays have one.
    directions: (height + 2, width + 2, 3), unit.  NaN where a ray does not reach the gel.
    """
    width, height = view.placement.width, view.placement.height
    v, u = np.mgrid[-BORDER : height + BORDER, -BORDER : width + BORDER].astype(np.float64)
    origins, directions = view.rays(np.stack([u, v], axis=-1))
    if not view.layers:
        origins = view.centre.reshape(1, 1, 3)
    return np.ascontiguousarray(origins), np.ascontiguousarray(directions)


# Triangles over the deformed surface as a view shows them: visibility and first guesses.


@dataclass(frozen=True)
class SurfaceMesh:
    """Mesh points of a view: material coordinates x (cols,), y (rows,), m.

    shown (rows, cols): points that the lens model can show.  pixel_m: size of a pixel on the
    surface at rest, m.
    """

    view: ViewGeometry
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    shown: NDArray[np.bool_]
    pixel_m: float

    @classmethod
    def from_view(cls, view: ViewGeometry, rest: SplineSurface) -> SurfaceMesh:
        """A mesh for the view of a surface, from the undeformed one."""
        half = rest.half_x, rest.half_y
        coarse = [np.linspace(-side, side, FEWEST_CELLS + 1) for side in half]
        step = np.hypot(coarse[0][1] - coarse[0][0], coarse[1][1] - coarse[1][0])
        pixels = view.project(_points(rest, *coarse))
        diagonal = np.linalg.norm(pixels[1:, 1:] - pixels[:-1, :-1], axis=-1)
        pixel_m = float(step / np.nanmedian(diagonal))
        x, y = (_coordinates(side, pixel_m) for side in half)
        points = _points(rest, x, y)
        with np.errstate(invalid="ignore"):
            origins, directions = view.rays(view.project(points))
            off = np.linalg.norm(np.cross(points - origins, directions), axis=-1)
            return cls(view, x, y, off < LENS_TOLERANCE_M, pixel_m)

    def project(self, surface: SplineSurface) -> NDArray[np.float64]:
        """Mesh points as seen: (rows, cols, 3) of x, y px and 1 / depth; NaN where not shown."""
        points = _points(surface, self.x, self.y)
        pixels = self.view.project(points)
        T = self.view.T_view_gel
        depth = points @ T[2, :3] + T[2, 3]
        seen = np.concatenate([pixels, 1 / depth[..., None]], axis=-1)
        seen[~self.shown | ~(depth > 0)] = np.nan
        return seen

    def guesses(
        self, seen: NDArray[np.float64], rows: tuple[int, int], out: NDArray[np.float64]
    ) -> None:
        """Nearest material point of each pixel of these rows of `out`, as `rasterize` gives it.

        seen: of `project`.  out (height + 2, width + 2, 4): pixel (0, 0) of the view is out[1, 1].
        """
        rasterize(seen, (self.x, self.y), out, BORDER, rows)


def _coordinates(half: float, pixel_m: float) -> NDArray[np.float64]:
    cells = int(np.clip(2 * half / (CELL_PX * pixel_m), FEWEST_CELLS, MOST_CELLS))
    beyond = BEYOND_PX * pixel_m
    inner = np.linspace(-half, half, cells + 1)
    return np.concatenate([[-half - beyond], inner, [half + beyond]])


def _points(
    surface: SplineSurface, x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    grid_y, grid_x = np.meshgrid(y, x, indexing="ij")
    flat = np.stack([grid_x.ravel(), grid_y.ravel()], axis=-1)
    return np.asarray(surface_points(surface, flat)).reshape(*grid_x.shape, 3)


# Draws a lattice of material points into the picture, the nearest in front.


@kernel
def rasterize(
    seen: NDArray[np.float64],
    lattice: tuple[NDArray[np.float64], NDArray[np.float64]],
    out: NDArray[np.float64],
    border: int,
    band: tuple[int, int],
) -> None:
    """Fill the rows of a band (first, last + 1) of `out` (h, w, 4).

    out: material x, y (m), 1 / depth, and the pixel's size (m): mean of its sides on the skin.
    seen (rows, cols, 3): pixel and 1 / depth of the lattice's points.  lattice: their x (cols,)
    and y (rows,), m.  Pixel (0, 0) is out[border, border].  NaN where no triangle covers a pixel's
    centre; of several triangles the nearest, of equally near ones the first.
    """
    x, y = lattice
    out[band[0] : band[1]] = np.nan
    for row in range(seen.shape[0] - 1):
        for col in range(seen.shape[1] - 1):
            low = min(
                seen[row, col, 1],
                seen[row, col + 1, 1],
                seen[row + 1, col, 1],
                seen[row + 1, col + 1, 1],
            )
            high = max(
                seen[row, col, 1],
                seen[row, col + 1, 1],
                seen[row + 1, col, 1],
                seen[row + 1, col + 1, 1],
            )
            if high + border < band[0] or low + border > band[1] - 1:
                continue
            corner = (seen[row, col], x[col], y[row])
            across = (seen[row, col + 1], x[col + 1], y[row])
            along = (seen[row + 1, col], x[col], y[row + 1])
            opposite = (seen[row + 1, col + 1], x[col + 1], y[row + 1])
            _draw((corner, across, opposite), out, border, band)
            _draw((corner, opposite, along), out, border, band)


@kernel_part(forceinline=True)
def _slopes(triangle: Any, kind: Any, area: float) -> Any:
    """Change of a coordinate, 1 for x and 2 for y, along and across a pixel."""
    a, b, c = triangle
    first, second = b[kind] - a[kind], c[kind] - a[kind]
    right = first * (c[0][1] - a[0][1]) - second * (b[0][1] - a[0][1])
    down = second * (b[0][0] - a[0][0]) - first * (c[0][0] - a[0][0])
    return right / area, down / area


@kernel_part(forceinline=True)
def _draw(triangle: Any, out: NDArray[np.float64], border: int, band: tuple[int, int]) -> None:
    a, b, c = triangle
    qa, qb, qc = a[0], b[0], c[0]
    area = (qb[0] - qa[0]) * (qc[1] - qa[1]) - (qb[1] - qa[1]) * (qc[0] - qa[0])
    if not abs(area) > 0:
        return
    xu, xv = _slopes(triangle, 1, area)
    yu, yv = _slopes(triangle, 2, area)
    size = (np.sqrt(xu * xu + yu * yu) + np.sqrt(xv * xv + yv * yv)) / 2
    share = 1 / area
    top = int(max(np.ceil(min(qa[1], qb[1], qc[1])) + border, band[0]))
    bottom = int(min(np.floor(max(qa[1], qb[1], qc[1])) + border, band[1] - 1))
    left = int(max(np.ceil(min(qa[0], qb[0], qc[0])) + border, 0))
    right = int(min(np.floor(max(qa[0], qb[0], qc[0])) + border, out.shape[1] - 1))
    for v in range(top, bottom + 1):
        for u in range(left, right + 1):
            px, py = u - border, v - border
            wa = ((qb[0] - px) * (qc[1] - py) - (qb[1] - py) * (qc[0] - px)) * share
            wb = ((qc[0] - px) * (qa[1] - py) - (qc[1] - py) * (qa[0] - px)) * share
            wc = 1 - wa - wb
            if wa < -1e-9 or wb < -1e-9 or wc < -1e-9:
                continue
            wa, wb, wc = wa * qa[2], wb * qb[2], wc * qc[2]
            near = wa + wb + wc
            if not out[v, u, 2] >= near:
                # Straight in space, not in the picture.
                far = 1 / near
                out[v, u, 0] = (wa * a[1] + wb * b[1] + wc * c[1]) * far
                out[v, u, 1] = (wa * a[2] + wb * b[2] + wc * c[2]) * far
                out[v, u, 2] = near
                out[v, u, 3] = size


class OpticalTruth:
    """What is true of the frames of one sensor.  Raises InputError for one without a block."""

    def __init__(self, sensor: SensorDescription) -> None:
        self._pattern = sensor.pattern
        self._size = BlockGeometry.from_sensor(sensor).size[:2]
        self._numbers = _marker_numbers(sensor.pattern.shape)
        rest = DeformedSurface.rest(sensor.pattern).spline(self._size)
        self._meshes = {
            name: SurfaceMesh.from_view(view, rest) for name, view in build_views(sensor).items()
        }

    def grids(self, surface: DeformedSurface) -> dict[str, Grid]:
        """Exact gridlines of each view, px of the view, with its placement.

        Virtual markers divide a segment into equal parts of the undeformed pattern.  Points
        outside the view's part of the frame, and those that the surface itself hides, are missing.
        """
        spline = surface.spline(self._size)
        grids = {}
        for name, mesh in self._meshes.items():
            seen = _Sight(mesh, spline)
            corners, row_lines, col_lines = (
                seen.pixels(surface.material(i, j)) for i, j in self._numbers
            )
            reason = _reason(corners)
            grids[name] = Grid(
                shape=self._pattern.shape,
                corners=corners,
                corner_status=_status(corners),
                row_lines=row_lines,
                row_line_status=_status(row_lines),
                col_lines=col_lines,
                col_line_status=_status(col_lines),
                residual_px=0.0,
                reason=reason,
                placement=mesh.view.placement,
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


class _Sight:
    """What a view sees of a surface."""

    def __init__(self, mesh: SurfaceMesh, surface: SplineSurface) -> None:
        self._view: ViewGeometry = mesh.view
        self._surface = surface
        self._alike = ALIKE_PIXELS * mesh.pixel_m
        place = mesh.view.placement
        self._guesses = np.empty((place.height + 2 * BORDER, place.width + 2 * BORDER, 4))
        mesh.guesses(mesh.project(surface), (0, len(self._guesses)), self._guesses)

    def pixels(self, material: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (..., 2) of the view of material points (..., 2) m; NaN where they are not seen.

        A point is seen where its ray meets the surface nowhere nearer: that is looked for from
        what the pixels around it show.
        """
        xy = material.reshape(-1, 2)
        q = self._view.project(surface_points(self._surface, np.ascontiguousarray(xy)))
        place = self._view.placement
        with np.errstate(invalid="ignore"):
            inside = (q > -0.5).all(axis=1) & (q < (place.width - 0.5, place.height - 0.5)).all(
                axis=1
            )
        found = np.full_like(q, np.nan)
        origins, directions = self._view.rays(q[inside])
        # The point itself first: most are seen.
        starts = np.concatenate([xy[inside][:, None], self._around(q[inside])], axis=1)
        first = first_meetings(self._surface, origins, directions, starts, self._alike)
        off = np.linalg.norm(first - xy[inside], axis=1)
        found[inside] = np.where((off < SAME_POINT_M)[:, None], q[inside], np.nan)
        return found.reshape(material.shape)

    def _around(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Material points (n, 9, 2) that the pixel of each point and those around it show."""
        col, row = np.rint(q).astype(np.intp).T + BORDER
        near = np.arange(-1, 2)
        rows = (row[:, None, None] + near[:, None]).clip(0, self._guesses.shape[0] - 1)
        cols = (col[:, None, None] + near).clip(0, self._guesses.shape[1] - 1)
        return np.asarray(self._guesses[rows, cols, :2].reshape(len(q), 9, 2))


def _status(points: NDArray[np.float64]) -> NDArray[np.uint8]:
    seen = np.isfinite(points[..., 0])
    return np.where(seen, Status.MEASURED, Status.MISSING).astype(np.uint8)


def _reason(corners: NDArray[np.float64]) -> str:
    missing = int(np.isnan(corners[..., 0]).sum())
    return f"{missing} corners hidden or outside the view" if missing else ""
