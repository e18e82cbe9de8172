"""Rigid bodies that press on the gel: what they can be asked, and triangle meshes from files."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage

from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_processing.errors import InputError

Array = NDArray[np.float64]
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
    """Raise InputError for a radius outside MIN_SIZE..high, m; `owner` names shape and key."""
    if not MIN_SIZE <= value <= high:
        msg = f"{owner}: found {value!r} m, expected {MIN_SIZE:g} to {high:.6g} m"
        raise InputError(msg)


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
        Raises InputError with file, found and expected: for a file that cannot be read, a mesh
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
        gap, normal = self.heights.distance(p_start)
        return gap, normal @ self.rotation


def _read(path: Path) -> Any:
    """The mesh of a file, checked but for its size."""
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except LOAD_ERRORS as error:
        msg = f"{path}: mesh file: cannot be read ({error}), expected STL, OBJ, PLY, OFF or glTF"
        raise InputError(msg) from None
    faces = len(getattr(mesh, "faces", ()))
    if not 0 < faces <= MAX_FACES:
        kind = "too fine" if faces else "no mesh"
        msg = f"{path}: {kind}: found {faces} faces, expected 1 to {MAX_FACES}"
        raise InputError(msg)
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
        raise InputError(msg)
    with np.errstate(invalid="ignore", divide="ignore"):
        volume = float(mesh.volume)
    if not abs(volume) > 1e-9 * float(np.prod(mesh.extents)):
        msg = f"{path}: found a volume of {volume:.3g}, expected a solid body"
        raise InputError(msg)


def _check_size(path: Path, extent: Array, scale: float) -> None:
    longest = float(extent.max())
    if MIN_EXTENT <= longest <= MAX_EXTENT:
        return
    msg = (
        f"{path}: size: found {longest:.3g} m along the longest side with scale {scale:g}, "
        f"expected {MIN_EXTENT:g} to {MAX_EXTENT:g} m; for a file in mm use scale 0.001"
    )
    raise InputError(msg)


def _fineness(path: Path, extent: Array, edge_radius: float | None) -> tuple[float, float]:
    """Resolution of the heights and radius of the edges, m, for the extent (2,) m that is seen."""
    narrowest = float(extent.min())
    if edge_radius is not None and not 0 <= edge_radius <= narrowest / 2:
        # A ball wider than the outline would leave nothing of the solid.
        msg = (
            f"{path}: edge_radius: found {edge_radius!r} m, expected 0 to {narrowest / 2:.3g} m, "
            "half of the shorter side as seen from above"
        )
        raise InputError(msg)
    finest = max(float(extent.max()) / DEFAULT_POINTS, FINEST_DEFAULT)
    resolution = max(finest, (edge_radius or 0.0) / MAX_BALL_CELLS)
    if resolution > narrowest / 2:
        msg = (
            f"{path}: size: found {narrowest:.3g} m along the shorter side as seen from above, "
            f"expected at least {2 * resolution:.3g} m"
        )
        raise InputError(msg)
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

    def distance(self, points: Array) -> tuple[Array, Array]:
        """Distance (k,) m of points (k, 3) along z, shortened by the slope, and normals (k, 3).

        Height and slope are bilinear between grid points, so that normals have no jumps; beyond the
        grid the surface goes on rising.
        """
        return _distance(self.height, self.slope, self.corner, self.resolution, points)


@kernel
def _distance(
    height: Array, slope: Array, corner: tuple[float, float], resolution: float, points: Array
) -> tuple[Array, Array]:
    rows, cols = height.shape
    gap, normal = np.empty(len(points)), np.empty((len(points), 3))
    for k in range(len(points)):
        x, y = (points[k, 0] - corner[0]) / resolution, (points[k, 1] - corner[1]) / resolution
        if not np.isfinite(x + y):
            gap[k], normal[k] = np.nan, np.nan
            continue
        inside_x, inside_y = min(max(x, 0.0), cols - 1.0), min(max(y, 0.0), rows - 1.0)
        beyond = resolution * np.hypot(x - inside_x, y - inside_y)
        j, i = min(int(inside_x), cols - 2), min(int(inside_y), rows - 2)
        v, u = inside_x - j, inside_y - i
        near, far = (1 - u) * (1 - v), u * v
        right, up = (1 - u) * v, u * (1 - v)
        z = near * height[i, j] + right * height[i, j + 1]
        z += up * height[i + 1, j] + far * height[i + 1, j + 1]
        for c in range(2):
            normal[k, c] = near * slope[i, j, c] + right * slope[i, j + 1, c]
            normal[k, c] += up * slope[i + 1, j, c] + far * slope[i + 1, j + 1, c]
        steepness = np.sqrt(normal[k, 0] ** 2 + normal[k, 1] ** 2 + 1.0)
        gap[k] = (z + WALL_SLOPE * beyond - points[k, 2]) / steepness
        normal[k, 0] /= steepness
        normal[k, 1] /= steepness
        normal[k, 2] = -1.0 / steepness
    return gap, normal


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
