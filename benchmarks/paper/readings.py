"""Measurements of a contact by a method, with its virtual markers or by its corners alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from cmp_tactile_processing.measured import Status, Surface, SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Pattern
from cmp_tactile_processing.surface.dense import SurfaceInterpolator, grid_over
from cmp_tactile_simulation.rendering.renderer import RenderedFrame
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from paper.chain import CMP, CMP_PAPER, Chain, Method
from paper.dot_tracking import DMP_FLOW, DMP_GRID, DMP_NEAREST
from paper.gel import Mechanics
from paper.sequence import PrintedGel


def without_virtual(surface: Surface) -> Surface:
    """The surface with its corners as they are and no virtual marker."""
    rows, cols = surface.row_status, surface.col_status
    return replace(
        surface,
        row_position=np.full((*rows.shape, 3), np.nan),
        row_status=np.full_like(rows, Status.MISSING),
        row_std=np.full_like(surface.row_std, np.nan),
        col_position=np.full((*cols.shape, 3), np.nan),
        col_status=np.full_like(cols, Status.MISSING),
        col_std=np.full_like(surface.col_std, np.nan),
    )


Array = NDArray[np.float64]


class DepthField:
    """Interpolates the markers of one sensor to nodes so far apart, m; nothing is extrapolated."""

    def __init__(self, pattern: Pattern, spacing: float) -> None:
        self.grid = grid_over(pattern.shape, pattern.pitch, spacing)
        self._interpolator = SurfaceInterpolator(pattern.shape, pattern.pitch, self.grid)

    def displacement(self, surface: Surface) -> Array:
        """Displacement (rows, cols, 3) m at the nodes; NaN where nothing is known."""
        return self._interpolator.interpolate(surface).displacement

    def depth(self, surface: Surface) -> Array:
        """Depth (rows, cols) m at the nodes, along the gel's axis."""
        return -self.displacement(surface)[..., 2]


def true_displacement(surface: DeformedSurface, xy: Array) -> Array:
    """Displacement (..., 3) m of the material points at (x, y) (..., 2) m."""
    rest = np.concatenate([xy, surface.pattern.surface.height(xy)[..., None]], axis=-1)
    return np.asarray(surface.at_material(xy) - rest)


def nodes_of(grid: SurfaceGrid) -> Array:
    """Material coordinates of a grid's nodes, (rows, cols, 2) m."""
    return grid.points.reshape(grid.rows, grid.cols, 2)


def sampled(grid: SurfaceGrid, field: Array, xy: Array) -> Array:
    """A field (rows, cols) at places (n, 2) m, linearly between the nodes; NaN beyond them."""
    (dx, dy), (left, top) = grid.spacing, (grid.x[0], grid.y[0])
    places = np.stack([(xy[:, 1] - top) / dy, (xy[:, 0] - left) / dx])
    return np.asarray(map_coordinates(field, places, order=1, mode="constant", cval=np.nan))


REST_FRAMES = 3
# Noise differs with a frame's number, and so by the seed.
NUMBERS_PER_SEED = 10_000


@dataclass(frozen=True)
class Course:
    """One course of frames as one method measured it.

    method: key.  seed: of the noise.  rest: at rest, measured REST_FRAMES times.
    surfaces: by number of the frame in the mechanics.
    """

    method: str
    seed: int
    rest: Sequence[Surface]
    surfaces: Mapping[int, Surface]


@dataclass(frozen=True)
class Reading:
    """key: of results; label: of tables.  method: None for exact markers.

    corners_only: virtual markers are left out; dots have none.
    """

    key: str
    label: str
    method: Method | None
    corners_only: bool = False

    def choose(self, surface: Surface) -> Surface:
        """What the reading takes of a surface."""
        return without_virtual(surface) if self.corners_only else surface

    def courses(self, measured: Sequence[Course], exact: Course) -> list[Course]:
        """Those of its method, or the exact markers."""
        if self.method is None:
            return [exact]
        return [course for course in measured if course.method == self.method.key]


READINGS = (
    Reading("cmp", "CMP, with virtual markers", CMP),
    Reading("cmp_corners", "CMP, corners only", CMP, corners_only=True),
    Reading("cmp_paper", "CMP of the paper, with virtual markers", CMP_PAPER),
    Reading("dmp_nearest", "DMP, nearest neighbour", DMP_NEAREST, corners_only=True),
    Reading("dmp_grid", "DMP, ordered by its grid", DMP_GRID, corners_only=True),
    Reading("dmp_flow", "DMP, optical flow", DMP_FLOW, corners_only=True),
    Reading("exact", "exact markers, virtual ones included", None),
    Reading("exact_corners", "exact markers, corners only", None, corners_only=True),
)
MEASURED = tuple(reading for reading in READINGS if reading.method is not None)
# Keys of those of dots.
DOTS = tuple(r.key for r in MEASURED if r.method is not None and r.method.pattern_type == "dmp")


class BothPrints:
    """Frames of mechanics on both prints, rendered once, to be measured under several noises."""

    def __init__(self, sensor: SensorDescription) -> None:
        self.sensor = sensor
        self._gels = {kind: PrintedGel(sensor, kind) for kind in ("cmp", "dmp")}
        rest = DeformedSurface.rest(sensor.pattern)
        self._rest = {kind: gel.rendered(rest) for kind, gel in self._gels.items()}
        methods = {r.method.key: r.method for r in MEASURED if r.method is not None}
        self._methods = tuple(methods.values())
        self._chains: dict[tuple[str, int], tuple[Chain, Sequence[Surface]]] = {}

    def courses(
        self, mechanics: Mechanics, frames: Sequence[int], seeds: Sequence[int]
    ) -> Iterator[Course]:
        """Measure these frames in order, from rest, with every method under every noise."""
        rendered = {
            kind: [gel.rendered(mechanics.surface(f, self.sensor.pattern)) for f in frames]
            for kind, gel in self._gels.items()
        }
        for method in self._methods:
            for seed in seeds:
                yield self._course(method, frames, rendered[method.pattern_type], seed)

    def true_surface(self, mechanics: Mechanics, frame: int) -> Surface:
        """Exact markers of a frame."""
        return self._gels["cmp"].truth(mechanics.surface(frame, self.sensor.pattern)).surface

    @property
    def rest_surface(self) -> Surface:
        """Exact markers of the gel at rest."""
        return self._gels["cmp"].truth(DeformedSurface.rest(self.sensor.pattern)).surface

    def _course(
        self, method: Method, frames: Sequence[int], rendered: Sequence[RenderedFrame], seed: int
    ) -> Course:
        gel, first = self._gels[method.pattern_type], seed * NUMBERS_PER_SEED
        chain, rest = self._at_rest(method, seed)
        chain.reset()
        surfaces = {
            frame: chain.measure(gel.exposed(item, first + REST_FRAMES + place)).surface
            for place, (frame, item) in enumerate(zip(frames, rendered, strict=True))
        }
        return Course(method.key, seed, rest, surfaces)

    def _at_rest(self, method: Method, seed: int) -> tuple[Chain, Sequence[Surface]]:
        """A chain that has its reference, and what it measures of the frames of that."""
        if (method.key, seed) not in self._chains:
            gel, first = self._gels[method.pattern_type], seed * NUMBERS_PER_SEED
            rendered = self._rest[method.pattern_type]
            images = [gel.exposed(rendered, first + number) for number in range(REST_FRAMES)]
            chain = Chain(self.sensor, method)
            chain.set_reference(images)
            rest = [chain.measure(image).surface for image in images]
            self._chains[method.key, seed] = chain, rest
        return self._chains[method.key, seed]


def name_of(reading: Reading) -> str:
    """The method's label, and which markers are taken."""
    if reading.method is None:
        return reading.label
    if reading.method.pattern_type == "dmp":
        return reading.method.label
    markers = "corners only" if reading.corners_only else "with virtual markers"
    return f"{reading.method.label}, {markers}"
