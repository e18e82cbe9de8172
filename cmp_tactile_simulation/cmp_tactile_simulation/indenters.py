"""Rigid bodies that press on the gel: shapes, and triangle meshes from files.

In: shape and size, or a mesh file.
Out: signed distance and normal at any point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage

from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_simulation.errors import IndenterError

Array = NDArray[np.float64]
# More spheres than these are a mesh rather than a group.
MAX_SPHERES = 1000
MAX_FACES = 2_000_000
# Between these, m, is what fits on or under a fingertip; elsewhere the unit is mistaken.
MIN_EXTENT, MAX_EXTENT = 1e-4, 0.2
# The default resolution: this many grid points over the longer side, but no finer than needed.
DEFAULT_POINTS, FINEST_DEFAULT = 800, 2e-5
# The work of rounding edges grows with the square of this: grid points over a ball's radius.
MAX_BALL_CELLS = 24
# Heights along z cannot be taken for those of another face, so that steps may be longer than
# the edges' radius.
SHORTEST_FEATURE = 1e-4
# What trimesh raises for files that are not what their name says.
LOAD_ERRORS = (
    OSError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,
    ImportError,
    RuntimeError,
    MemoryError,
)
# The least radius of an edge, m.
MIN_SIZE = 1e-6
# Walls that a view along z cannot see, those round the outline, lean outwards by this slope.
WALL_SLOPE = 50.0


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
            [
                (radial - (self.radius - self.edge_radius), outward),
                _slab(p_indenter, 0, self.length / 2 - self.edge_radius),
            ],
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
            [
                (radial - (self.diameter / 2 - self.edge_radius), outward),
                _slab(middle, 2, self.length / 2 - self.edge_radius),
            ],
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
        slabs = [
            _slab(p_indenter, axis, side / 2 - self.edge_radius)
            for axis, side in enumerate(self.size)
        ]
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
            [
                (profile, np.concatenate([np.zeros((len(outward), 1)), outward], axis=1)),
                _slab(p_indenter, 0, self.length / 2 - self.edge_radius),
            ],
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
            raise IndenterError(msg)

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


def _polar(vectors: Array, otherwise: int = -1) -> tuple[Array, Array]:
    """Lengths and unit vectors; one of length 0 is taken to point along the axis `otherwise`."""
    length = np.linalg.norm(vectors, axis=1)
    zero = length == 0
    direction = vectors / np.where(zero, 1.0, length)[:, None]
    direction[zero, otherwise] = 1.0
    return length, direction


def _slab(points: Array, axis: int, half: float) -> tuple[Array, Array]:
    """Signed distance from |points[axis]| <= half, and its normal."""
    normal = np.zeros_like(points)
    normal[:, axis] = np.where(points[:, axis] < 0, -1.0, 1.0)
    return np.abs(points[:, axis]) - half, normal


def _grown(parts: list[tuple[Array, Array]], radius: float) -> tuple[Array, Array]:
    """Intersection of solids with normals at right angles to each other, grown by a radius."""
    distances = np.stack([distance for distance, _ in parts])
    normals = np.stack([normal for _, normal in parts])
    beyond = np.maximum(distances, 0.0)
    outside = np.sqrt((beyond**2).sum(axis=0))
    nearest = distances.argmax(axis=0)
    points = np.arange(distances.shape[1])
    inner = normals[nearest, points]
    is_out = outside > 0
    outer = (beyond[..., None] * normals).sum(axis=0) / np.where(is_out, outside, 1.0)[:, None]
    gap = outside + np.minimum(distances[nearest, points], 0.0) - radius
    return gap, np.where(is_out[:, None], outer, inner)


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


# What the contact solver needs to know of a rigid indenter.


class Indenter(Protocol):
    """A rigid solid in its own frame, m: unturned, its -z side faces the gel.

    The origin is the indenter's reference point: forces' torques are about it.  It is the centre
    of the solid's bounding box, but the middle of the tip of a flat probe, and the given origin
    of a group of spheres.
    """

    @property
    def name(self) -> str:
        """What messages call the indenter."""

    @property
    def feature(self) -> float:
        """Smallest radius of curvature of the surface, m: no step may be much longer."""

    @property
    def reach(self) -> float:
        """Radius of a sphere about the origin that holds the whole solid, m."""

    def distance(
        self, p_indenter: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Signed distance (k,) m of points (k, 3), negative inside, and outward normals (k, 3).

        The normal is the indenter's at the surface point nearest to the point, a unit vector.
        """


def check_radius(owner: str, value: float, high: float) -> None:
    """Raise IndenterError for a radius outside MIN_SIZE..high, m; `owner` names shape and key."""
    if not MIN_SIZE <= value <= high:
        msg = f"{owner}: found {value!r} m, expected {MIN_SIZE:g} to {high:.6g} m"
        raise IndenterError(msg)


@dataclass(frozen=True)
class MeshIndenter:
    """The underside of a mesh, an `Indenter`; the origin is the middle of its bounding box.

    Only what is seen from below, along the gel's z axis with the indenter turned as at the start,
    is there: undercuts are filled, walls along that view lean a little outwards, and there is no
    upper side.  Distances are taken along the view and shortened by the slope: exact in sign, and
    at the surface.  A later tilt is that of the underside alone.
    name: of the file.  heights: in the turned frame.  edge_radius: rounding of edges, m.
    reach: m.  rotation (3, 3): from the mesh's own axes, the indenter's frame, to that frame.
    """

    name: str
    heights: HeightField
    edge_radius: float
    reach: float
    rotation: Array = field(default_factory=lambda: np.eye(3))

    @classmethod
    def load(
        cls,
        path: Path,
        scale: float = 1.0,
        edge_radius: float | None = None,
        rotation: Array | None = None,
    ) -> MeshIndenter:
        """Read a closed mesh (STL, OBJ, PLY, OFF, glTF).

        scale: from the file's unit to m, 0.001 for a file in mm.  edge_radius: m; default two
        points of the heights, of which there are 800 along the longer side.
        rotation (3, 3): of the indenter in the gel frame at the start; default unturned.
        Raises IndenterError with file, found and expected: for a file that cannot be read, a mesh
        with more than MAX_FACES faces, not watertight or without volume, and for a size out of
        range.
        """
        turn = np.eye(3) if rotation is None else rotation
        mesh = _read(path)
        low, high = scale * np.asarray(mesh.bounds)
        _check_size(path, high - low, scale)
        triangles = scale * np.asarray(mesh.triangles, dtype=np.float64) - (low + high) / 2
        triangles = triangles @ turn.T
        extent = np.ptp(triangles.reshape(-1, 3), axis=0)[:2]
        resolution, edge_radius = _fineness(path, extent, edge_radius)
        # A ball as wide as the outline would not fit between the grid's points in it.
        ball = min(edge_radius, max(float(extent.min()) / 2 - resolution, 0.0))
        heights = HeightField.of_triangles(triangles, resolution, ball)
        return cls(path.name, heights, edge_radius, float(np.linalg.norm(high - low)) / 2, turn)

    @property
    def feature(self) -> float:
        """The edges' radius, m, or what may be taken for it."""
        return max(self.edge_radius, SHORTEST_FEATURE)

    def distance(self, p_indenter: Array) -> tuple[Array, Array]:
        """See Indenter.distance."""
        p_start = p_indenter @ self.rotation.T
        height, slope = self.heights.at(p_start[:, :2])
        normal = np.concatenate([slope, -np.ones((len(slope), 1))], axis=1)
        steepness = np.linalg.norm(normal, axis=1)
        gap = (height - p_start[:, 2]) / steepness
        return gap, (normal / steepness[:, None]) @ self.rotation


def _read(path: Path) -> Any:
    """The mesh of a file, checked but for its size."""
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except LOAD_ERRORS as error:
        msg = f"{path}: mesh file: cannot be read ({error}), expected STL, OBJ, PLY, OFF or glTF"
        raise IndenterError(msg) from None
    faces = len(getattr(mesh, "faces", ()))
    if not 0 < faces <= MAX_FACES:
        kind = "too fine" if faces else "no mesh"
        msg = f"{path}: {kind}: found {faces} faces, expected 1 to {MAX_FACES}"
        raise IndenterError(msg)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    _check_closed(path, mesh)
    return mesh


def _check_closed(path: Path, mesh: Any) -> None:
    if not mesh.is_watertight:
        edges = np.sort(mesh.edges, axis=1)
        _, counts = np.unique(edges, axis=0, return_counts=True)
        msg = (
            f"{path}: found {int((counts != 2).sum())} edges that do not join two faces, expected "
            "a closed (watertight) surface"
        )
        raise IndenterError(msg)
    with np.errstate(invalid="ignore", divide="ignore"):
        volume = float(mesh.volume)
    if not abs(volume) > 1e-9 * float(np.prod(mesh.extents)):
        msg = f"{path}: found a volume of {volume:.3g}, expected a solid body"
        raise IndenterError(msg)


def _check_size(path: Path, extent: Array, scale: float) -> None:
    longest = float(extent.max())
    if MIN_EXTENT <= longest <= MAX_EXTENT:
        return
    msg = (
        f"{path}: size: found {longest:.3g} m along the longest side with scale {scale:g}, "
        f"expected {MIN_EXTENT:g} to {MAX_EXTENT:g} m; for a file in mm use scale 0.001"
    )
    raise IndenterError(msg)


def _fineness(path: Path, extent: Array, edge_radius: float | None) -> tuple[float, float]:
    """Resolution of the heights and radius of the edges, m, for the extent (2,) m that is seen."""
    narrowest = float(extent.min())
    if edge_radius is not None and not 0 <= edge_radius <= narrowest / 2:
        # A ball wider than the outline would leave nothing of the solid.
        msg = (
            f"{path}: edge_radius: found {edge_radius!r} m, expected 0 to {narrowest / 2:.3g} m, "
            "half of the shorter side as seen from above"
        )
        raise IndenterError(msg)
    finest = max(float(extent.max()) / DEFAULT_POINTS, FINEST_DEFAULT)
    resolution = max(finest, (edge_radius or 0.0) / MAX_BALL_CELLS)
    if resolution > narrowest / 2:
        msg = (
            f"{path}: size: found {narrowest:.3g} m along the shorter side as seen from above, "
            f"expected at least {2 * resolution:.3g} m"
        )
        raise IndenterError(msg)
    return resolution, min(2 * resolution, narrowest / 4) if edge_radius is None else edge_radius


# The underside of a solid as heights over a grid.


@dataclass(frozen=True)
class HeightField:
    """The lowest surface of a solid over a regular grid in x and y, seen from below.

    corner: (x, y) m of the first grid point.  resolution: m.  height (rows, cols) m: row i lies
    at y = corner[1] + i resolution.  slope (rows, cols, 2): its derivative along x and y.
    """

    corner: tuple[float, float]
    resolution: float
    height: Array
    slope: Array

    @classmethod
    def of_triangles(cls, triangles: Array, resolution: float, edge_radius: float) -> HeightField:
        """The underside of a closed surface, its edges rounded by a ball.

        triangles: (n, 3, 3) corners, m.  edge_radius: m, 0 leaves the edges as they are; parts
        thinner than twice the radius disappear.
        """
        margin = edge_radius + 2 * resolution
        low = triangles[..., :2].min(axis=(0, 1)) - margin
        high = triangles[..., :2].max(axis=(0, 1)) + margin
        cols, rows = (np.ceil((high - low) / resolution).astype(int) + 1).tolist()
        height = np.full((rows, cols), np.inf)
        _lower(height, triangles, low, resolution)
        height = _rounded(_walled(height, resolution), edge_radius, resolution)
        by_y, by_x = np.gradient(height, resolution)
        return cls((float(low[0]), float(low[1])), resolution, height, np.stack([by_x, by_y], -1))

    def at(self, points: Array) -> tuple[Array, Array]:
        """Height (k,) m and slope (k, 2) at points (k, 2) m; beyond the grid it goes on rising.

        Both are bilinear between grid points, so that the slope has no jumps.
        """
        rows, cols = self.height.shape
        q = (points - self.corner) / self.resolution
        inside = np.clip(q, 0, [cols - 1, rows - 1])
        beyond = self.resolution * np.linalg.norm(q - inside, axis=1)
        at = inside.T[::-1]
        height = ndimage.map_coordinates(self.height, at, order=1, mode="nearest")
        slope = [
            ndimage.map_coordinates(self.slope[..., axis], at, order=1, mode="nearest")
            for axis in range(2)
        ]
        return height + WALL_SLOPE * beyond, np.stack(slope, axis=-1)


@kernel
def _lower(height: Array, triangles: Array, corner: Array, resolution: float) -> None:
    """Lower each height, in place, to the lowest of the triangles over or under its point."""
    rows, cols = height.shape
    for t in range(len(triangles)):
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = triangles[t]
        double_area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if double_area == 0.0:
            continue
        first_i = max(0, int(np.ceil((min(ay, by, cy) - corner[1]) / resolution)))
        last_i = min(rows - 1, int(np.floor((max(ay, by, cy) - corner[1]) / resolution)))
        first_j = max(0, int(np.ceil((min(ax, bx, cx) - corner[0]) / resolution)))
        last_j = min(cols - 1, int(np.floor((max(ax, bx, cx) - corner[0]) / resolution)))
        for i in range(first_i, last_i + 1):
            y = corner[1] + i * resolution
            for j in range(first_j, last_j + 1):
                x = corner[0] + j * resolution
                of_b = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / double_area
                of_c = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / double_area
                of_a = 1.0 - of_b - of_c
                # A hair beyond the edges, lest points on a common edge fall between two triangles.
                if min(of_a, of_b, of_c) >= -1e-9:
                    z = of_a * az + of_b * bz + of_c * cz
                    height[i, j] = min(height[i, j], z)


def _walled(height: Array, resolution: float) -> Array:
    """Points outside the outline get a wall that rises from the nearest point of the outline."""
    outside = ~np.isfinite(height)
    away, (i, j) = ndimage.distance_transform_edt(outside, return_indices=True)
    return np.asarray(height[i, j] + WALL_SLOPE * resolution * away)


def _rounded(height: Array, radius: float, resolution: float) -> Array:
    """All that a ball can fill from within the solid: its opening."""
    reach = int(np.floor(radius / resolution))
    if reach == 0:
        return height
    steps = resolution * np.arange(-reach, reach + 1)
    rest = radius**2 - steps[:, None] ** 2 - steps**2
    ball = np.sqrt(np.maximum(rest, 0.0))
    ball[rest < 0] = -np.inf
    grown = _dilated(np.pad(height, reach, mode="edge"), ball)
    return np.asarray(-_dilated(np.pad(-grown, reach, mode="edge"), ball))


@kernel
def _dilated(padded: Array, ball: Array) -> Array:
    """The upper envelope of the ball over each point; padded: by the ball's reach on each side.

    As scipy.ndimage.grey_dilation, but row by row, which is many times as fast.
    """
    size = len(ball)
    rows, cols = padded.shape[0] - size + 1, padded.shape[1] - size + 1
    result = np.full((rows, cols), -np.inf)
    for i in range(rows):
        row = result[i]
        for di in range(size):
            source = padded[i + di]
            for dj in range(size):
                lift = ball[di, dj]
                if lift == -np.inf:
                    continue
                for j in range(cols):
                    z = source[j + dj] + lift
                    row[j] = max(row[j], z)
    return result
