"""Measurements of a contact by a method, with its virtual markers or by its corners alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from cmp_tactile_processing.measured import Surface, SurfaceGrid, no_virtual_markers
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Pattern
from cmp_tactile_processing.surface.dense import SurfaceInterpolator, grid_over
from cmp_tactile_simulation.rendering.renderer import RenderedFrame
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from paper.chain import CMP, CMP_PAPER, Chain, Method
from paper.dot_trackers import DMP_FLOW, DMP_GRID, DMP_NEAREST
from paper.lab import Mechanics
from paper.sequence import PrintedGel


def without_virtual(surface: Surface) -> Surface:
    """The surface with its corners as they are and no virtual marker."""
    none: dict[str, Any] = no_virtual_markers(surface.shape)
    return replace(surface, **none)


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
class Contact:
    """The mean of the gel at rest and a frame of a contact, as a reading has them."""

    rest: Surface
    pressed: Surface


@dataclass(frozen=True)
class Reading:
    """key: of results; label: of tables.  method: None for exact markers.

    corners_only: virtual markers are left out; dots have none.
    """

    key: str
    label: str
    method: Method | None
    corners_only: bool = False

    def choose(self, contact: Contact) -> Contact:
        """What the reading takes of both surfaces."""
        if not self.corners_only:
            return contact
        return Contact(without_virtual(contact.rest), without_virtual(contact.pressed))


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
        # Exact markers of the gel at rest.
        self.rest = self._gels["cmp"].truth(rest).surface
        self._chains: dict[tuple[str, int], tuple[Chain, Surface]] = {}

    def contacts(
        self, mechanics: Mechanics, frames: Sequence[int], seeds: Sequence[int]
    ) -> dict[str, list[Contact]]:
        """The last of these frames by every reading's key, under every noise.

        They are shown in order, from rest.  Of exact markers, each noise has the same.
        """
        surfaces = [mechanics.surface(frame, self.sensor.pattern) for frame in frames]
        rendered = {
            kind: [gel.rendered(surface) for surface in surfaces]
            for kind, gel in self._gels.items()
        }
        exact = Contact(self.rest, self._gels["cmp"].truth(surfaces[-1]).surface)
        methods = {r.method.key: r.method for r in MEASURED if r.method is not None}
        found = {
            key: [self._measured(method, rendered[method.pattern_type], seed) for seed in seeds]
            for key, method in methods.items()
        }
        found[""] = [exact] * len(seeds)
        return {
            reading.key: [
                reading.choose(contact)
                for contact in found[reading.method.key if reading.method else ""]
            ]
            for reading in READINGS
        }

    def _measured(self, method: Method, rendered: Sequence[RenderedFrame], seed: int) -> Contact:
        gel, first = self._gels[method.pattern_type], seed * NUMBERS_PER_SEED + REST_FRAMES
        chain, rest = self._at_rest(method, seed)
        chain.reset()
        for number, item in enumerate(rendered, first):
            pressed = chain.measure(gel.exposed(item, number)).surface
        return Contact(rest, pressed)

    def _at_rest(self, method: Method, seed: int) -> tuple[Chain, Surface]:
        """A chain that has its reference, and the mean that it measures of the frames of that."""
        if (method.key, seed) not in self._chains:
            gel, first = self._gels[method.pattern_type], seed * NUMBERS_PER_SEED
            rendered = self._rest[method.pattern_type]
            images = [gel.exposed(rendered, first + number) for number in range(REST_FRAMES)]
            chain = Chain(self.sensor, method)
            chain.set_reference(images)
            rest = mean_of([chain.measure(image).surface for image in images])
            self._chains[method.key, seed] = chain, rest
        return self._chains[method.key, seed]


def mean_of(surfaces: Sequence[Surface]) -> Surface:
    """The first of several measurements with the mean positions of all; NaN where one has none."""
    means = {
        name: np.mean([getattr(surface, name) for surface in surfaces], axis=0)
        for name in ("position", "row_position", "col_position")
    }
    return replace(surfaces[0], **means)


def name_of(reading: Reading) -> str:
    """The method's label, and which markers are taken."""
    if reading.method is None:
        return reading.label
    if reading.method.pattern_type == "dmp":
        return reading.method.label
    markers = "corners only" if reading.corners_only else "with virtual markers"
    return f"{reading.method.label}, {markers}"
