"""The marker surface of the gel in one state, as a smooth function of material coordinates.

A material point is named by its place (x, y) on the undeformed surface, gel frame, m.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.sensor.parts import Pattern, PatternSurface

# A cubic that passes through the points needs so many along each side.
LEAST_POINTS = 4
PLANE, SPHERE, CYLINDER_X, CYLINDER_Y = range(4)

NEWTON_STEPS = 25
# Error that is left, m; sharper features than this radius, m, do not occur on the surface.
TOLERANCE = 1e-9
SMALLEST_RADIUS = 2e-4
# Near a fold the tangent points far away.
LONGEST_STEP = 3e-4


@dataclass(frozen=True)
class DeformedSurface:
    """Rest shape of the pattern plus a displacement known on a grid, gel frame, m.

    displacement (rows, cols, 3) m of the material points that lie on the grid's points at rest.
    Between them it is a bicubic spline through all of them, beyond the grid it goes on linearly.
    """

    pattern: Pattern
    grid: SurfaceGrid
    displacement: NDArray[np.float64]

    @classmethod
    def rest(cls, pattern: Pattern) -> DeformedSurface:
        """The undeformed surface."""
        extent = (pattern.cols - 1) * pattern.pitch, (pattern.rows - 1) * pattern.pitch
        grid = SurfaceGrid(LEAST_POINTS, LEAST_POINTS, extent)
        return cls(pattern, grid, np.zeros((LEAST_POINTS, LEAST_POINTS, 3)))

    def at(self, i: NDArray[np.float64], j: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions (..., 3) m of the material points at fractional rows i and columns j.

        Corner (i, j) of the pattern is at whole numbers; NaN outside the sphere or cylinder.
        """
        return self.at_material(self.material(i, j))

    def material(self, i: NDArray[np.float64], j: NDArray[np.float64]) -> NDArray[np.float64]:
        """Material coordinates (x, y) (..., 2) m of fractional rows i and columns j."""
        i, j = np.broadcast_arrays(np.asarray(i, dtype=np.float64), np.asarray(j, np.float64))
        x = (j - (self.pattern.cols - 1) / 2) * self.pattern.pitch
        y = (i - (self.pattern.rows - 1) / 2) * self.pattern.pitch
        return np.stack([x, y], axis=-1)

    def at_material(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions (..., 3) m of the material points that lay at (x, y) (..., 2) m at rest."""
        flat = np.ascontiguousarray(xy, dtype=np.float64).reshape(-1, 2)
        return np.asarray(surface_points(self.spline(), flat)).reshape(*np.shape(xy)[:-1], 3)

    def corners(self) -> NDArray[np.float64]:
        """The pattern's corners, (rows, cols, 3) m."""
        i, j = np.mgrid[: self.pattern.rows, : self.pattern.cols].astype(np.float64)
        return self.at(i, j)

    def spline(self, size: tuple[float, float] = (np.inf, np.inf)) -> SplineSurface:
        """What compiled code needs of it; beyond `size` (x, y) m the rest shape goes on flat."""
        return SplineSurface.from_grid(self.pattern.surface, self.grid, self._coefficients, size)

    @cached_property
    def _coefficients(self) -> NDArray[np.float64]:
        return spline_coefficients(np.asarray(self.displacement, dtype=np.float64))


# The deformed marker surface as compiled code evaluates it: rest shape plus cubic spline.


class SplineSurface(NamedTuple):
    """What `surface_point` reads.

    coefficients (rows + 2, cols + 2, 3): uniform cubic B-spline of the displacement, m; the
    first grid point lies at (x, y), the spacings' inverses are per_x, per_y (1/m).
    kind, radius: the rest shape; beyond half_x, half_y (m) it goes on along its tangent.
    """

    coefficients: NDArray[np.float64]
    x: float
    y: float
    per_x: float
    per_y: float
    kind: int
    radius: float
    half_x: float
    half_y: float

    @classmethod
    def from_grid(
        cls,
        rest: PatternSurface,
        grid: SurfaceGrid,
        coefficients: NDArray[np.float64],
        size: tuple[float, float] = (np.inf, np.inf),
    ) -> SplineSurface:
        """Arrays for a rest shape of that size along x and y, m, displaced as the grid says."""
        kind = {"plane": PLANE, "sphere_cap": SPHERE, "cylinder": CYLINDER_X}[rest.type]
        if kind == CYLINDER_X and rest.axis == "y":
            kind = CYLINDER_Y
        step_x, step_y = grid.spacing
        return cls(
            coefficients,
            -grid.extent[0] / 2,
            -grid.extent[1] / 2,
            1 / step_x,
            1 / step_y,
            kind,
            float(rest.radius),
            size[0] / 2,
            size[1] / 2,
        )


def spline_coefficients(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients (rows + 2, cols + 2, k) of the cubic spline through values (rows, cols, k).

    Not-a-knot at the sides: cubics are reproduced.  At least 4 x 4 values.
    """
    along_y = _interpolation_inverse(values.shape[0])
    along_x = _interpolation_inverse(values.shape[1])
    half = _product(along_y, np.ascontiguousarray(values))
    turned = _product(along_x, np.ascontiguousarray(half.transpose(1, 0, 2)))
    return np.ascontiguousarray(turned.transpose(1, 0, 2))


@kernel
def _product(matrix: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """A matrix (m, n) times values (n, p, k): without BLAS, the last digits of which depend on how
    many threads it has at the moment.
    """
    product = np.zeros((len(matrix), values.shape[1], values.shape[2]))
    for i in range(len(matrix)):
        out = product[i].ravel()
        for n in range(len(values)):
            factor, row = matrix[i, n], values[n].ravel()
            for k in range(len(row)):
                out[k] += factor * row[k]
    return product


@lru_cache(maxsize=16)
def _interpolation_inverse(count: int) -> NDArray[np.float64]:
    """(count + 2, count): coefficients of the spline through unit values."""
    matrix = np.zeros((count + 2, count + 2))
    for row in range(count):
        matrix[row + 1, row : row + 3] = 1 / 6, 4 / 6, 1 / 6
    # The third derivative goes on through the second and the last but one point.
    matrix[0, :5] = matrix[-1, -5:] = 1, -4, 6, -4, 1
    return np.asarray(np.linalg.inv(matrix)[:, 1:-1])


@kernel_part(forceinline=True)
def _rest_height(kind: int, radius: float, x: float, y: float) -> Any:
    """Height of the rest shape and its slopes along x and y."""
    if kind == PLANE:
        return 0.0, 0.0, 0.0
    if kind == CYLINDER_X:
        x = 0.0
    elif kind == CYLINDER_Y:
        y = 0.0
    distance2 = x * x + y * y
    root = np.sqrt(radius * radius - distance2)
    return -distance2 / (radius + root), -x / root, -y / root


@kernel_part(forceinline=True)
def _clamped(value: float, low: float, high: float) -> float:
    # Written so that NaN becomes `low`: it may index nothing.
    return min(value, high) if value > low else low


@kernel_part(forceinline=True)
def _basis(t: float) -> Any:
    """The four uniform cubic B-splines at t = 0..1 between two points, then their slopes."""
    m = 1 - t
    middle, last = (3 * t - 6) * t * t / 6 + 4 / 6, t * t * t / 6
    third = ((-3 * t + 3) * t + 3) * t / 6 + 1 / 6
    rise, fall = (-3 * t + 2) * t / 2 + 0.5, (3 * t - 4) * t / 2
    return m * m * m / 6, middle, third, last, -m * m / 2, fall, rise, t * t / 2


@kernel_part(forceinline=True)
def surface_point(s: SplineSurface, x: float, y: float) -> Any:
    """Position of material point (x, y) and its derivatives along x and y: nine numbers.

    Beyond the grid the displacement goes on linearly, and beyond the half-widths the rest shape.
    """
    xr, yr = _clamped(x, -s.half_x, s.half_x), _clamped(y, -s.half_y, s.half_y)
    z, zx, zy = _rest_height(s.kind, s.radius, xr, yr)
    z += zx * (x - xr) + zy * (y - yr)

    rows, cols = s.coefficients.shape[0] - 2, s.coefficients.shape[1] - 2
    u, v = (x - s.x) * s.per_x, (y - s.y) * s.per_y
    uc, vc = _clamped(u, 0.0, cols - 1.0), _clamped(v, 0.0, rows - 1.0)
    col, row = min(int(uc), cols - 2), min(int(vc), rows - 2)
    w0, w1, w2, w3, d0, d1, d2, d3 = _basis(uc - col)
    basis = _basis(vc - row)
    px = py = pz = ax = ay = az = bx = by = bz = 0.0
    for k in range(4):
        c = s.coefficients[row + k]
        fx = w0 * c[col, 0] + w1 * c[col + 1, 0] + w2 * c[col + 2, 0] + w3 * c[col + 3, 0]
        fy = w0 * c[col, 1] + w1 * c[col + 1, 1] + w2 * c[col + 2, 1] + w3 * c[col + 3, 1]
        fz = w0 * c[col, 2] + w1 * c[col + 1, 2] + w2 * c[col + 2, 2] + w3 * c[col + 3, 2]
        gx = d0 * c[col, 0] + d1 * c[col + 1, 0] + d2 * c[col + 2, 0] + d3 * c[col + 3, 0]
        gy = d0 * c[col, 1] + d1 * c[col + 1, 1] + d2 * c[col + 2, 1] + d3 * c[col + 3, 1]
        gz = d0 * c[col, 2] + d1 * c[col + 1, 2] + d2 * c[col + 2, 2] + d3 * c[col + 3, 2]
        weight, rise = basis[k], basis[k + 4]
        px, py, pz = px + weight * fx, py + weight * fy, pz + weight * fz
        ax, ay, az = ax + weight * gx, ay + weight * gy, az + weight * gz
        bx, by, bz = bx + rise * fx, by + rise * fy, bz + rise * fz
    ax, ay, az = ax * s.per_x, ay * s.per_x, az * s.per_x
    bx, by, bz = bx * s.per_y, by * s.per_y, bz * s.per_y
    beyond_x, beyond_y = (u - uc) / s.per_x, (v - vc) / s.per_y
    px += ax * beyond_x + bx * beyond_y + x
    py += ay * beyond_x + by * beyond_y + y
    pz += az * beyond_x + bz * beyond_y + z
    return px, py, pz, ax + 1, ay, az + zx, bx, by + 1, bz + zy


@kernel
def surface_points(s: SplineSurface, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions (n, 3) m of material points (n, 2) m."""
    points = np.empty((len(xy), 3))
    for k in range(len(xy)):
        p = surface_point(s, xy[k, 0], xy[k, 1])
        points[k, 0], points[k, 1], points[k, 2] = p[0], p[1], p[2]
    return points


# Where a ray meets the deformed surface: Newton's method in material coordinates.


@kernel
def meet(
    s: SplineSurface, origin: NDArray[np.float64], d: NDArray[np.float64], x: float, y: float
) -> Any:
    """Material point (x, y) m where the ray meets the surface, searched from a guess.

    Returns whether it was found, x, y and the distance along the ray, m.
    """
    for _ in range(NEWTON_STEPS):
        px, py, pz, ax, ay, az, bx, by, bz = surface_point(s, x, y)
        rx, ry, rz = px - origin[0], py - origin[1], pz - origin[2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        facing = nx * d[0] + ny * d[1] + nz * d[2]
        if facing == 0:
            return False, x, y, 0.0
        t = (nx * rx + ny * ry + nz * rz) / facing
        # What is left lies in the tangent plane.
        ex, ey, ez = t * d[0] - rx, t * d[1] - ry, t * d[2] - rz
        area2 = nx * nx + ny * ny + nz * nz
        step_x = (
            nx * (ey * bz - ez * by) + ny * (ez * bx - ex * bz) + nz * (ex * by - ey * bx)
        ) / area2
        step_y = (
            nx * (ay * ez - az * ey) + ny * (az * ex - ax * ez) + nz * (ax * ey - ay * ex)
        ) / area2
        length2 = step_x * step_x + step_y * step_y
        if not length2 < np.inf:
            return False, x, y, 0.0
        if length2 > LONGEST_STEP * LONGEST_STEP:
            shorter = LONGEST_STEP / np.sqrt(length2)
            step_x, step_y = step_x * shorter, step_y * shorter
        x, y = x + step_x, y + step_y
        if length2 * np.sqrt(area2) < TOLERANCE * SMALLEST_RADIUS * abs(facing):
            return True, x, y, t
    return False, x, y, 0.0


@kernel_part
def first_meeting(
    s: SplineSurface,
    origin: NDArray[np.float64],
    direction: NDArray[np.float64],
    starts: NDArray[np.float64],
    alike: float,
) -> Any:
    """The nearest of the meetings found from several guesses (k, 2) m, as `meet` returns it.

    Meetings behind the origin or beyond the surface's size do not count, nor do guesses with NaN
    or within `alike` (m) of an earlier one.
    """
    found, best_x, best_y, nearest = False, 0.0, 0.0, np.inf
    for k in range(len(starts)):
        new = starts[k, 0] == starts[k, 0]
        for earlier in range(k):
            off = abs(starts[k, 0] - starts[earlier, 0]) + abs(starts[k, 1] - starts[earlier, 1])
            new = new and not off < alike
        if not new:
            continue
        good, x, y, t = meet(s, origin, direction, starts[k, 0], starts[k, 1])
        inside = abs(x) <= s.half_x and abs(y) <= s.half_y
        if good and inside and 0 < t < nearest:
            found, best_x, best_y, nearest = True, x, y, t
    return found, best_x, best_y, nearest


@kernel
def first_meetings(
    s: SplineSurface,
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    starts: NDArray[np.float64],
    alike: float,
) -> NDArray[np.float64]:
    """Material points (n, 2) m where n rays first meet the surface; NaN where they do not.

    origins, directions (n, 3); starts (n, k, 2): guesses for each ray, as `first_meeting` takes
    them.
    """
    xy = np.full((len(origins), 2), np.nan)
    for k in range(len(origins)):
        found, x, y, _ = first_meeting(s, origins[k], directions[k], starts[k], alike)
        if found:
            xy[k, 0], xy[k, 1] = x, y
    return xy
