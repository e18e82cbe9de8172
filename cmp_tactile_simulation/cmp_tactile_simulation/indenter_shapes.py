"""Indenters of simple shape, by exact signed distance; edges are rounded by a radius.

A rounded solid is a smaller solid with sharp edges, grown by the radius.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_processing.errors import InputError
from cmp_tactile_simulation.indenters import check_radius

Array = NDArray[np.float64]
# More spheres than these are a mesh rather than a group.
MAX_SPHERES = 1000


@dataclass(frozen=True)
class Sphere:
    """A ball about the origin.  radius: m."""

    radius: float
    name: ClassVar[str] = "sphere"

    @property
    def feature(self) -> float:
        """The radius, m."""
        return self.radius

    @property
    def reach(self) -> float:
        """The radius, m."""
        return self.radius

    def distance(self, p_indenter: Array) -> tuple[Array, Array]:
        """See Indenter.distance."""
        length, direction = _polar(p_indenter)
        return length - self.radius, direction


@dataclass(frozen=True)
class Cylinder:
    """A cylinder about the x axis: unturned it lies on the gel.

    radius, length: m.  edge_radius: rounding of the two rims, m, at most the radius.
    """

    radius: float
    length: float
    edge_radius: float = 2e-4
    name: ClassVar[str] = "cylinder"

    def __post_init__(self) -> None:
        limit = min(self.radius, self.length / 2)
        check_radius("cylinder.edge_radius", self.edge_radius, limit)

    @property
    def feature(self) -> float:
        """The rims' radius, m."""
        return self.edge_radius

    @property
    def reach(self) -> float:
        """Distance from the middle to the rims, m."""
        return float(np.hypot(self.radius, self.length / 2))

    def distance(self, p_indenter: Array) -> tuple[Array, Array]:
        """See Indenter.distance."""
        radial, outward = _polar(p_indenter * (0.0, 1.0, 1.0))
        return _grown(
            (
                (radial - (self.radius - self.edge_radius), outward),
                _slab(p_indenter, 0, self.length / 2 - self.edge_radius),
            ),
            self.edge_radius,
        )


@dataclass(frozen=True)
class FlatProbe:
    """A pin that points along -z, with a flat tip; the origin is the middle of the tip.

    diameter, length: m.  edge_radius: rounding of the tip's edge, m, at most half the diameter.
    """

    diameter: float = 6e-4
    length: float = 0.02
    edge_radius: float = 5e-5
    name: ClassVar[str] = "flat_probe"

    def __post_init__(self) -> None:
        limit = min(self.diameter, self.length) / 2
        check_radius("flat_probe.edge_radius", self.edge_radius, limit)

    @property
    def feature(self) -> float:
        """The edge's radius, m."""
        return self.edge_radius

    @property
    def reach(self) -> float:
        """Distance from the tip to the far end, m."""
        return float(np.hypot(self.length, self.diameter / 2))

    def distance(self, p_indenter: Array) -> tuple[Array, Array]:
        """See Indenter.distance."""
        radial, outward = _polar(p_indenter * (1.0, 1.0, 0.0), otherwise=0)
        middle = p_indenter - (0.0, 0.0, self.length / 2)
        return _grown(
            (
                (radial - (self.diameter / 2 - self.edge_radius), outward),
                _slab(middle, 2, self.length / 2 - self.edge_radius),
            ),
            self.edge_radius,
        )


@dataclass(frozen=True)
class Cuboid:
    """A box: unturned its lower face meets the gel; turn it to press with an edge or a corner.

    size: along x, y, z, m.  edge_radius: rounding of edges and corners, m.
    """

    size: tuple[float, float, float]
    edge_radius: float = 2e-4
    name: ClassVar[str] = "cuboid"

    def __post_init__(self) -> None:
        check_radius("cuboid.edge_radius", self.edge_radius, min(self.size) / 2)

    @property
    def feature(self) -> float:
        """The edges' radius, m."""
        return self.edge_radius

    @property
    def reach(self) -> float:
        """Distance from the middle to the corners, m."""
        return float(np.linalg.norm(self.size)) / 2

    def distance(self, p_indenter: Array) -> tuple[Array, Array]:
        """See Indenter.distance."""
        slabs = tuple(
            _slab(p_indenter, axis, side / 2 - self.edge_radius)
            for axis, side in enumerate(self.size)
        )
        return _grown(slabs, self.edge_radius)


@dataclass(frozen=True)
class Ring:
    """A torus about the z axis: unturned it lies on the gel.

    radius: from the middle to the centre line of the tube, m.  tube_radius: m, below the radius.
    """

    radius: float
    tube_radius: float
    name: ClassVar[str] = "ring"

    def __post_init__(self) -> None:
        check_radius("ring.tube_radius", self.tube_radius, self.radius)

    @property
    def feature(self) -> float:
        """The tube's radius, m."""
        return self.tube_radius

    @property
    def reach(self) -> float:
        """Outer radius, m."""
        return self.radius + self.tube_radius

    def distance(self, p_indenter: Array) -> tuple[Array, Array]:
        """See Indenter.distance."""
        _, outward = _polar(p_indenter * (1.0, 1.0, 0.0), otherwise=0)
        length, direction = _polar(p_indenter - self.radius * outward)
        return length - self.tube_radius, direction


@dataclass(frozen=True)
class HexagonalBar:
    """A hexagonal bar along the x axis, as the handle of a hex key: unturned it lies on a flat.

    across_flats, length: m.  edge_radius: rounding of all edges, m.
    """

    across_flats: float
    length: float
    edge_radius: float = 2e-4
    name: ClassVar[str] = "hexagonal_bar"

    def __post_init__(self) -> None:
        limit = min(self.across_flats, self.length) / 2
        check_radius("hexagonal_bar.edge_radius", self.edge_radius, limit)

    @property
    def feature(self) -> float:
        """The edges' radius, m."""
        return self.edge_radius

    @property
    def reach(self) -> float:
        """Distance from the middle to the corners, m."""
        return float(np.hypot(self.across_flats / np.sqrt(3), self.length / 2))

    def distance(self, p_indenter: Array) -> tuple[Array, Array]:
        """See Indenter.distance."""
        profile, outward = _hexagon(p_indenter[:, 1:], self.across_flats / 2 - self.edge_radius)
        return _grown(
            (
                (profile, np.concatenate([np.zeros((len(outward), 1)), outward], axis=1)),
                _slab(p_indenter, 0, self.length / 2 - self.edge_radius),
            ),
            self.edge_radius,
        )


@dataclass(frozen=True)
class SphereGroup:
    """Several balls of one radius that move as one.  centres: (n, 3) m.  radius: m."""

    centres: Sequence[Sequence[float]]
    radius: float
    name: ClassVar[str] = "sphere_group"

    def __post_init__(self) -> None:
        centres = np.asarray(self.centres, dtype=np.float64)
        if centres.ndim != 2 or centres.shape[1:] != (3,) or not 0 < len(centres) <= MAX_SPHERES:
            msg = (
                f"sphere_group.centres: found an array of shape {centres.shape}, expected 1 to "
                f"{MAX_SPHERES} points of 3 numbers"
            )
            raise InputError(msg)

    @property
    def feature(self) -> float:
        """The spheres' radius, m."""
        return self.radius

    @property
    def reach(self) -> float:
        """Distance from the origin to the far side of the farthest sphere, m."""
        return float(np.linalg.norm(self.centres, axis=1).max()) + self.radius

    def distance(self, p_indenter: Array) -> tuple[Array, Array]:
        """See Indenter.distance."""
        length = np.full(len(p_indenter), np.inf)
        direction = np.zeros_like(p_indenter)
        for centre in np.asarray(self.centres, dtype=np.float64):
            to_this, outward = _polar(p_indenter - centre)
            nearer = to_this < length
            length[nearer], direction[nearer] = to_this[nearer], outward[nearer]
        return length - self.radius, direction


@kernel
def _polar(vectors: Array, otherwise: int = -1) -> tuple[Array, Array]:
    """Lengths and unit vectors; one of length 0 is taken to point along the axis `otherwise`."""
    length, direction = np.empty(len(vectors)), np.zeros(vectors.shape)
    for k in range(len(vectors)):
        length2 = 0.0
        for c in range(vectors.shape[1]):
            length2 += vectors[k, c] * vectors[k, c]
        length[k] = np.sqrt(length2)
        if length[k] == 0:
            direction[k, otherwise] = 1.0
            continue
        for c in range(vectors.shape[1]):
            direction[k, c] = vectors[k, c] / length[k]
    return length, direction


@kernel
def _slab(points: Array, axis: int, half: float) -> tuple[Array, Array]:
    """Signed distance from |points[axis]| <= half, and its normal."""
    distance, normal = np.empty(len(points)), np.zeros(points.shape)
    for k in range(len(points)):
        distance[k] = abs(points[k, axis]) - half
        normal[k, axis] = -1.0 if points[k, axis] < 0 else 1.0
    return distance, normal


@kernel
def _grown(parts: tuple[tuple[Array, Array], ...], radius: float) -> tuple[Array, Array]:
    """Intersection of solids with normals at right angles to each other, grown by a radius."""
    gap, normal = np.empty(len(parts[0][0])), np.zeros(parts[0][1].shape)
    for k in range(len(gap)):
        outside2, nearest = 0.0, 0
        for n in range(len(parts)):
            beyond = max(parts[n][0][k], 0.0)
            outside2 += beyond * beyond
            for c in range(3):
                normal[k, c] += beyond * parts[n][1][k, c]
            nearest = n if parts[n][0][k] > parts[nearest][0][k] else nearest
        outside = np.sqrt(outside2)
        gap[k] = outside + min(parts[nearest][0][k], 0.0) - radius
        for c in range(3):
            inner = parts[nearest][1][k, c]
            normal[k, c] = normal[k, c] / outside if outside > 0 else inner
    return gap, normal


def _hexagon(points: Array, inner_radius: float) -> tuple[Array, Array]:
    """Signed distance (k,) and normal (k, 2) of a hexagon with flats towards -y and +y."""
    angles = np.pi / 2 + np.pi / 3 * np.arange(6)
    flats = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    along = np.stack([-flats[:, 1], flats[:, 0]], axis=-1)
    height = points @ flats.T - inner_radius
    nearest = height.argmax(axis=1)
    depth = height[np.arange(len(points)), nearest]
    half_side = inner_radius / np.sqrt(3)
    side = along[nearest]
    beside = (points * side).sum(axis=1)
    beside -= np.clip(beside, -half_side, half_side)
    length, direction = _polar(depth[:, None] * flats[nearest] + beside[:, None] * side)
    is_out = depth > 0
    return np.where(is_out, length, depth), np.where(is_out[:, None], direction, flats[nearest])
