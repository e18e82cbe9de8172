"""The elastomer block cut into hexahedra: its geometry, and a lattice of second-order nodes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import PatternSurface

# Below this share of the thickness at the apex the columns of elements under the block's
# corners are so flat that their shape spoils the solution.
MIN_THICKNESS_RATIO = 0.05
# From element to element of a thick block: the lowest ones carry its shear.
GENTLE_GROWTH = 1.35


@dataclass(frozen=True)
class BlockGeometry:
    """An elastomer block, gel frame, m: centred in x and y, bonded at z = base.

    `surface` is the marker surface; the contact surface lies `layer` above it, along z.
    size: along x, y and from the base to the contact surface at the apex.
    """

    size: tuple[float, float, float]
    surface: PatternSurface
    layer: float

    @classmethod
    def from_sensor(cls, sensor: SensorDescription) -> BlockGeometry:
        """The block of a sensor; GeometryError where its surface reaches the base."""
        elastomer = sensor.elastomer
        block = cls(elastomer.size, sensor.pattern.surface, elastomer.shading_layer.thickness)
        block.check(sensor.name)
        return block

    @property
    def base(self) -> float:
        """Height z of the bonded base, m."""
        return self.layer - self.size[2]

    def contact_points(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (n, 3) m of the undeformed contact surface above points (n, 2) m."""
        return np.concatenate([xy, (self.surface.height(xy) + self.layer)[:, None]], axis=1)

    def surface_stretch(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Area of the contact surface per area seen along z, at points (..., 2) m."""
        step = 1e-6 * max(self.size)
        slope2 = np.zeros(xy.shape[:-1])
        for offset in (np.array([step, 0.0]), np.array([0.0, step])):
            rise = self.surface.height(xy + offset) - self.surface.height(xy - offset)
            slope2 += (rise / (2 * step)) ** 2
        return np.sqrt(1 + slope2)

    def check(self, name: str) -> None:
        """Raise GeometryError where the surface comes too near to the base to be a block."""
        corner = np.array([self.size[0] / 2, self.size[1] / 2])
        lowest = float(self.surface.height(corner)) - self.base
        needed = MIN_THICKNESS_RATIO * self.size[2]
        # Written so that NaN, a block wider than its sphere or cylinder, fails as well.
        if not lowest >= needed:
            found = "wider than the surface's radius" if np.isnan(lowest) else f"{lowest:.3g} m"
            msg = (
                f"{name}: elastomer.size and pattern.surface: thickness under the marker surface "
                f"at the block's corner: found {found}, expected at least {needed:.3g} m"
            )
            raise GeometryError(msg)


@dataclass(frozen=True)
class MeshDensity:
    """How fine the block is cut.

    With the defaults the displacement of the markers of a 22 x 22 x 6 mm block differs from that
    on a mesh of 28 elements across, 5, 8 and 2 by 0.05 % under a smooth patch of 3 mm radius and
    0.2 % under one of 1.5 mm; with 14 across it is 0.24 and 1.1 %. The width counts: 3 elements
    of depth instead of 4 change 0.04 %, another element of layer or rim less than 0.01 %.

    across: elements over the wider side of the loaded area, half of them on either side.
    rim: elements from the loaded area to the block's side, growing outwards.
    depth: elements from the base to the marker surface, growing downwards by `growth`; a thick
    block needs more, see `deep_enough`.  layer: elements in the shading layer.
    """

    across: int = 20
    rim: int = 3
    depth: int = 4
    layer: int = 1
    growth: float = 1.5

    def deep_enough(self, thickness: float, tallest: float) -> MeshDensity:
        """With more elements, growing less, where the uppermost were higher than `tallest`.

        thickness: of the body, m.  tallest: m.  Under a patch of 2.5 mm radius on a body of 30 mm
        4 elements that grow by 1.5 are too stiff by 0.4 % for a press and 1.3 % for a drag, 9 that
        grow by 1.35 by 0.1 and 0.3 %, measured on 11 that grow by 1.25.
        """
        depth, growth = self.depth, self.growth
        while thickness / np.sum(growth ** np.arange(depth)) > tallest:
            depth, growth = depth + 1, min(growth, GENTLE_GROWTH)
        return replace(self, depth=depth, growth=growth)


@dataclass(frozen=True)
class BlockMesh:
    """Hexahedra in vertical columns over a rectangle; nodes form a lattice twice as fine.

    x_edges, y_edges: element edges, ascending, m.  body, layer: heights of the element edges as
    a share of the body (base to marker surface) and of the shading layer, from 0 to 1.
    """

    geometry: BlockGeometry
    x_edges: NDArray[np.float64]
    y_edges: NDArray[np.float64]
    body: NDArray[np.float64]
    layer: NDArray[np.float64]

    @classmethod
    def quarter(
        cls, geometry: BlockGeometry, loaded: tuple[float, float], density: MeshDensity
    ) -> BlockMesh:
        """The quarter x >= 0, y >= 0, uniform up to the half-widths `loaded`, m."""
        step = 2 * max(loaded) / density.across
        halves = [
            graded_half_line(min(width, size / 2), size / 2, step, density.rim)
            for width, size in zip(loaded, geometry.size, strict=False)
        ]
        depth = np.concatenate([[0.0], np.cumsum(density.growth ** -np.arange(density.depth))])
        has_layer = geometry.layer > 0
        layer = np.linspace(0, 1, density.layer + 1) if has_layer else np.zeros(1)
        return cls(geometry, halves[0], halves[1], depth / depth[-1], layer)

    def mirrored(self) -> BlockMesh:
        """The whole block, of which this is the quarter."""
        x, y = (np.concatenate([-edges[:0:-1], edges]) for edges in (self.x_edges, self.y_edges))
        return replace(self, x_edges=x, y_edges=y)

    @property
    def elements(self) -> tuple[int, int, int]:
        """Numbers of elements along x, y and z."""
        up = len(self.body) + len(self.layer) - 2
        return len(self.x_edges) - 1, len(self.y_edges) - 1, up

    @property
    def lattice(self) -> tuple[int, int, int]:
        """Numbers of nodes along x, y and z."""
        nx, ny, nz = self.elements
        return 2 * nx + 1, 2 * ny + 1, 2 * nz + 1

    @property
    def marker_level(self) -> int:
        """Lattice level of the marker surface; the contact surface is the last level."""
        return 2 * (len(self.body) - 1)

    def element_nodes(self) -> NDArray[np.intp]:
        """Numbers (ix * ny + iy) * nz + iz of the lattice nodes of each element, (elements, 27).

        Elements and the nodes of each are in the order of their place, x first, z last.
        """
        lattice = np.arange(np.prod(self.lattice)).reshape(self.lattice)
        cubes = np.lib.stride_tricks.sliding_window_view(lattice, (3, 3, 3))[::2, ::2, ::2]
        return np.ascontiguousarray(cubes.reshape(-1, 27), dtype=np.intp)

    def is_layer(self) -> NDArray[np.bool_]:
        """Which elements lie in the shading layer, (elements,)."""
        nodes = self.element_nodes()
        return np.asarray((nodes % self.lattice[2] > self.marker_level).any(axis=1))

    def nodes(self) -> NDArray[np.float64]:
        """Positions of the lattice nodes, (nx, ny, nz, 3) m, gel frame."""
        x, y = np.meshgrid(_midpoints_added(self.x_edges), _midpoints_added(self.y_edges))
        xy = np.stack([x.T, y.T], axis=-1)
        height = self.geometry.surface.height(xy)[..., None]
        base = self.geometry.base
        body = base + _midpoints_added(self.body) * (height - base)
        layer = height + _midpoints_added(self.layer)[1:] * self.geometry.layer
        z = np.concatenate([body, layer], axis=-1)
        nodes = np.empty((*z.shape, 3))
        nodes[..., :2] = xy[:, :, None]
        nodes[..., 2] = z
        return nodes


def graded_half_line(inner: float, outer: float, step: float, rim: int) -> NDArray[np.float64]:
    """Element edges from 0 to `outer`: about `step` wide up to `inner`, growing beyond, m."""
    count = max(1, round(inner / step))
    edges = np.linspace(0, inner, count + 1)
    rest = outer - inner
    if rest <= 0.3 * step:
        return edges * (outer / inner)
    rim = min(rim, max(1, round(rest / step)))
    growth = _growth(rest * count / inner, rim)
    beyond = np.cumsum(growth ** np.arange(1, rim + 1))
    return np.concatenate([edges, inner + rest * beyond / beyond[-1]])


def _growth(length: float, count: int) -> float:
    """Factor g with g + g^2 + ... + g^count = length, at least 1."""
    low, high = 1.0, 10.0
    for _ in range(40):
        middle = (low + high) / 2
        too_long = np.sum(middle ** np.arange(1, count + 1)) > length
        low, high = (low, middle) if too_long else (middle, high)
    return low


def _midpoints_added(edges: NDArray[np.float64]) -> NDArray[np.float64]:
    line = np.empty(2 * len(edges) - 1)
    line[::2] = edges
    line[1::2] = (edges[1:] + edges[:-1]) / 2
    return line
