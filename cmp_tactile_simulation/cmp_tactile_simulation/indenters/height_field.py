"""The underside of a solid as heights over a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

__all__ = ["HeightField"]

Array = NDArray[np.float64]

# Walls that a view along z cannot see, those round the outline, lean outwards by this slope.
WALL_SLOPE = 50.0


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
        Raises ValueError where the triangles cover no point of the grid.
        """
        margin = edge_radius + 2 * resolution
        low = triangles[..., :2].min(axis=(0, 1)) - margin
        high = triangles[..., :2].max(axis=(0, 1)) + margin
        cols, rows = (np.ceil((high - low) / resolution).astype(int) + 1).tolist()
        height = np.full((rows, cols), np.inf)
        _lower(height, triangles, low, resolution)
        if not np.isfinite(height).any():
            msg = f"no point of a grid of {resolution:.3g} m lies over the solid"
            raise ValueError(msg)
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


@njit(cache=True)
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


@njit(cache=True)
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
