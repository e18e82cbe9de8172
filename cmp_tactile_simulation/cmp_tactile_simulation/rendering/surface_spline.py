"""The deformed marker surface as compiled code evaluates it: rest shape plus cubic spline.

A material point is named by its place (x, y) on the undeformed surface, gel frame, m.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_processing.sensor.pattern import PatternSurface

__all__ = ["SplineSurface", "spline_coefficients", "surface_point", "surface_points"]

# A cubic that passes through the points needs so many along each side.
LEAST_POINTS = 4
PLANE, SPHERE, CYLINDER_X, CYLINDER_Y = range(4)


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
        """Arrays for a rest shape of that size along x and y, m, displaced as the grid tells."""
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
    half = np.tensordot(along_y, values, axes=(1, 0))
    return np.ascontiguousarray(np.tensordot(half, along_x, axes=(1, 1)).swapaxes(1, 2))


@lru_cache(maxsize=16)
def _interpolation_inverse(count: int) -> NDArray[np.float64]:
    """(count + 2, count): coefficients of the spline through unit values."""
    matrix = np.zeros((count + 2, count + 2))
    for row in range(count):
        matrix[row + 1, row : row + 3] = 1 / 6, 4 / 6, 1 / 6
    # The third derivative goes on through the second and the last but one point.
    matrix[0, :5] = matrix[-1, -5:] = 1, -4, 6, -4, 1
    return np.asarray(np.linalg.inv(matrix)[:, 1:-1])


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
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


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _clamped(value: float, low: float, high: float) -> float:
    # Written so that NaN becomes `low`: it may index nothing.
    return min(value, high) if value > low else low


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _basis(t: float) -> Any:
    """The four uniform cubic B-splines at t = 0..1 between two points, then their slopes."""
    m = 1 - t
    middle, last = (3 * t - 6) * t * t / 6 + 4 / 6, t * t * t / 6
    third = ((-3 * t + 3) * t + 3) * t / 6 + 1 / 6
    rise, fall = (-3 * t + 2) * t / 2 + 0.5, (3 * t - 4) * t / 2
    return m * m * m / 6, middle, third, last, -m * m / 2, fall, rise, t * t / 2


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
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


@njit(cache=True, nogil=True, error_model="numpy")
def surface_points(s: SplineSurface, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions (n, 3) m of material points (n, 2) m."""
    points = np.empty((len(xy), 3))
    for k in range(len(xy)):
        p = surface_point(s, xy[k, 0], xy[k, 1])
        points[k, 0], points[k, 1], points[k, 2] = p[0], p[1], p[2]
    return points
