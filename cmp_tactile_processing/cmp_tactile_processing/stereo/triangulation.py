"""Points in 3-D from rays, with covariance and the reason where there is none.

From pairs of rays, or of a monocular sensor from one ray and the known surface.

A pixel's error shifts its ray by D dq, D = origin_by_pixel + t direction_by_pixel.  Only the part
of D across the ray counts: A = (I - v v^T) D.  The common normal's middle is the point with the
least sum of squared distances to both rays; the weighted point has the least sum of squared
reprojection errors in units of their standard deviations, where a distance d across the ray is
the pixel error (A^T A)^-1 A^T d.  Both are linear about the feet of the common normal, which are
some um apart: further iterations would change nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.rectification import surface_intersection
from cmp_tactile_processing.geometry.refraction import RayBundle
from cmp_tactile_processing.measured import MarkerFault
from cmp_tactile_processing.sensor.parts import PatternSurface

# Rays that meet at a smaller angle than this (its sine squared) have no usable common normal.
PARALLEL_SINE2 = 1e-6
# No corner or gridline is known better than this, px, whatever its standard deviation says.
LEAST_STD_PX = 1e-3
NO_RAY, PARALLEL_RAYS = int(MarkerFault.NO_RAY), int(MarkerFault.PARALLEL_RAYS)
BEHIND_CAMERA, RAY_GAP = int(MarkerFault.BEHIND_CAMERA), int(MarkerFault.RAY_GAP)

Array: TypeAlias = NDArray[np.float64]
# Origin, direction, both by pixel, standard deviation.
View: TypeAlias = tuple[Array, Array, Array, Array, Array]


@dataclass(frozen=True)
class Triangulated:
    """Points (N, 3) m; NaN, with fault (N,) of MarkerFault, where there is none.

    covariance (N, 3, 3) m^2; gap (N,): length of the common normal, m, also of points whose gap
    is implausible.
    """

    position: NDArray[np.float64]
    covariance: NDArray[np.float64]
    gap: NDArray[np.float64]
    fault: NDArray[np.uint8]


def meet_surface(
    rays: RayBundle, std: NDArray[np.float64], surface: PatternSurface
) -> Triangulated:
    """Points (N, 3) of the undeformed marker surface on N rays; their z is the surface's own.

    std (N,): standard deviation of the pixels, px per coordinate.  The covariance's z entries are
    NaN; for the others the surface is taken as level around each point.
    """
    points = surface_intersection(rays.origin, rays.direction, surface)
    distance = np.linalg.norm(points - rays.origin, axis=-1)
    shift = rays.origin_by_pixel + distance[:, None, None] * rays.direction_by_pixel
    slope = rays.direction[:, :2] / rays.direction[:, 2:]
    in_plane = shift[:, :2] - slope[..., None] * shift[:, 2:]
    covariance = np.full((len(points), 3, 3), np.nan)
    covariance[:, :2, :2] = in_plane @ in_plane.swapaxes(1, 2) * std[:, None, None] ** 2
    fault = np.where(np.isfinite(points[:, 0]), MarkerFault.NONE, MarkerFault.NO_RAY)
    return Triangulated(points, covariance, np.full(len(points), np.nan), fault.astype(np.uint8))


def triangulate(
    rays: tuple[RayBundle, RayBundle],
    std: tuple[NDArray[np.float64], NDArray[np.float64]],
    *,
    weighted: bool,
    max_gap: float,
) -> Triangulated:
    """Points that pairs of rays (N) show.

    std: standard deviation (N,) of the pixels of each view, px per coordinate.  weighted: the least
    reprojection error instead of the middle of the common normal.  max_gap: longest plausible
    common normal, m.  Raises InputError unless all are as many.
    """
    n = len(rays[0].origin)
    counts = [n, len(rays[1].origin), len(std[0]), len(std[1])]
    if counts != [n] * 4:
        msg = f"triangulation: found {counts} rays and deviations, expected as many of each"
        raise InputError(msg)
    out = Triangulated(np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n), np.empty(n, np.uint8))
    _triangulate(
        _arrays(rays[0], std[0]),
        _arrays(rays[1], std[1]),
        weighted,
        max_gap,
        (out.position, out.covariance, out.gap, out.fault),
    )
    return out


def common_normal(
    o_left: NDArray[np.float64],
    v_left: NDArray[np.float64],
    o_right: NDArray[np.float64],
    v_right: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Midpoint and length of the common normal of pairs of rays (paper, IV.A, eq. 1-3).

    o_* (..., 3): ray origins, m.  v_* (..., 3): unit directions.  Returns points (..., 3) and
    lengths (...), m; NaN where the rays are parallel, meet behind an origin, or are NaN.
    """
    arrays = np.broadcast_arrays(o_left, v_left, o_right, v_right)
    flat = [np.ascontiguousarray(a, dtype=np.float64).reshape(-1, 3) for a in arrays]
    midpoint, gap = np.empty_like(flat[0]), np.empty(len(flat[0]))
    _common_normals((flat[0], flat[1]), (flat[2], flat[3]), midpoint, gap)
    shape = arrays[0].shape
    return midpoint.reshape(shape), gap.reshape(shape[:-1])


def _arrays(rays: RayBundle, std: NDArray[np.float64]) -> View:
    return (
        rays.origin,
        rays.direction,
        rays.origin_by_pixel,
        rays.direction_by_pixel,
        np.ascontiguousarray(std, dtype=np.float64),
    )


@kernel_part
def _feet(
    o_left: NDArray[np.float64],
    v_left: NDArray[np.float64],
    o_right: NDArray[np.float64],
    v_right: NDArray[np.float64],
) -> tuple[float, float, int]:
    """Distances along both rays to the feet of their common normal, and the fault or 0."""
    cosine = along_left = along_right = 0.0
    for a in range(3):
        between = o_right[a] - o_left[a]
        cosine += v_left[a] * v_right[a]
        along_left += between * v_left[a]
        along_right += between * v_right[a]
    sine2 = 1.0 - cosine * cosine
    if not math.isfinite(sine2 + along_left + along_right):
        return np.nan, np.nan, NO_RAY
    if not sine2 > PARALLEL_SINE2:
        return np.nan, np.nan, PARALLEL_RAYS
    t_left = (along_left - cosine * along_right) / sine2
    t_right = (cosine * along_left - along_right) / sine2
    fault = 0 if t_left > 0.0 and t_right > 0.0 else BEHIND_CAMERA
    return t_left, t_right, fault


@kernel
def _common_normals(
    left: tuple[Array, Array], right: tuple[Array, Array], midpoint: Array, gap: Array
) -> None:
    (o_left, v_left), (o_right, v_right) = left, right
    for n in range(len(gap)):
        t_left, t_right, fault = _feet(o_left[n], v_left[n], o_right[n], v_right[n])
        if fault:
            t_left = np.nan
        gap2 = 0.0
        for a in range(3):
            foot_left = o_left[n, a] + t_left * v_left[n, a]
            foot_right = o_right[n, a] + t_right * v_right[n, a]
            midpoint[n, a] = (foot_left + foot_right) / 2.0
            gap2 += (foot_right - foot_left) ** 2
        gap[n] = math.sqrt(gap2)


@kernel
def _triangulate(
    left: View,
    right: View,
    weighted: bool,
    max_gap: float,
    out: tuple[Array, Array, Array, NDArray[np.uint8]],
) -> None:
    """Fill out (position, covariance, gap, fault)."""
    position, covariance, gap, fault = out
    half, inverse = np.empty(3), np.empty((3, 3))
    # Sum and difference of the views' normal matrices, and the spread of the right-hand side.
    sums = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(gap)):
        t_left, t_right, fault[n] = _feet(left[0][n], left[1][n], right[0][n], right[1][n])
        gap2 = 0.0
        for a in range(3):
            foot_left = left[0][n, a] + t_left * left[1][n, a]
            foot_right = right[0][n, a] + t_right * right[1][n, a]
            position[n, a] = (foot_left + foot_right) / 2.0
            half[a] = (foot_right - foot_left) / 2.0
            gap2 += 4.0 * half[a] * half[a]
        gap[n] = math.sqrt(gap2) if fault[n] == 0 else np.nan
        if fault[n] == 0 and gap[n] > max_gap:
            fault[n] = RAY_GAP
        if fault[n]:
            position[n], covariance[n] = np.nan, np.nan
            continue
        for matrix in sums:
            matrix[:] = 0.0
        _add_view(left, n, (t_left, -1.0), weighted, sums)
        _add_view(right, n, (t_right, 1.0), weighted, sums)
        _invert(sums[0], inverse)
        if not weighted:
            _enclose(inverse, sums[2], covariance[n])
            continue
        for b in range(3):
            pull = sums[1][b, 0] * half[0] + sums[1][b, 1] * half[1] + sums[1][b, 2] * half[2]
            for a in range(3):
                covariance[n, a, b] = inverse[a, b]
                position[n, a] += inverse[a, b] * pull
        if not math.isfinite(position[n, 0] + position[n, 1] + position[n, 2]):
            # Pixels or deviations so large that nothing is left of the weights.
            position[n], covariance[n], fault[n] = np.nan, np.nan, NO_RAY


@kernel_part
def _add_view(
    view: View, n: int, place: tuple[float, float], weighted: bool, sums: tuple[Array, Array, Array]
) -> None:
    """Add the normal matrix of ray n to the sums; place: distance along it, sign of the view."""
    t, sign = place
    v, o_by, v_by, variance = view[1][n], view[2][n], view[3][n], view[4][n] ** 2
    # A, the shift across the ray by each pixel coordinate, as its two columns.
    ax, ay, az = (
        o_by[0, 0] + t * v_by[0, 0],
        o_by[1, 0] + t * v_by[1, 0],
        o_by[2, 0] + t * v_by[2, 0],
    )
    bx, by, bz = (
        o_by[0, 1] + t * v_by[0, 1],
        o_by[1, 1] + t * v_by[1, 1],
        o_by[2, 1] + t * v_by[2, 1],
    )
    along_a, along_b = ax * v[0] + ay * v[1] + az * v[2], bx * v[0] + by * v[1] + bz * v[2]
    first = (ax - along_a * v[0], ay - along_a * v[1], az - along_a * v[2])
    second = (bx - along_b * v[0], by - along_b * v[1], bz - along_b * v[2])
    normal, difference, spread = sums
    if weighted:
        g11, g12, g22 = _dot(first, first), _dot(first, second), _dot(second, second)
        det2 = (g11 * g22 - g12 * g12) ** 2 * variance
        # (A^T A)^-2 / variance.
        w11 = (g22 * g22 + g12 * g12) / det2
        w22 = (g11 * g11 + g12 * g12) / det2
        w12 = -g12 * (g11 + g22) / det2
    else:
        w11, w12, w22 = variance, 0.0, variance
    for a in range(3):
        for b in range(3):
            outer = (
                w11 * first[a] * first[b]
                + w12 * (first[a] * second[b] + second[a] * first[b])
                + w22 * second[a] * second[b]
            )
            spread[a, b] += outer
            weight = outer if weighted else (1.0 if a == b else 0.0) - v[a] * v[b]
            normal[a, b] += weight
            difference[a, b] += sign * weight


@kernel_part
def _dot(a: tuple[float, float, float], b: tuple[float, float, float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel_part
def _invert(m: Array, out: Array) -> None:
    """Inverse of a symmetric (3, 3)."""
    a, b, c, d, e, f = m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2]
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * c00 + b * c01 + c * c02
    out[0, 0], out[0, 1], out[0, 2] = c00 / det, c01 / det, c02 / det
    out[1, 0], out[1, 1], out[1, 2] = c01 / det, (a * f - c * c) / det, (b * c - a * e) / det
    out[2, 0], out[2, 1], out[2, 2] = c02 / det, out[1, 2], (a * d - b * b) / det


@kernel_part
def _enclose(inverse: Array, spread: Array, out: Array) -> None:
    """out = inverse spread inverse, all symmetric (3, 3)."""
    for a in range(3):
        for b in range(3):
            total = 0.0
            for c in range(3):
                for d in range(3):
                    total += inverse[a, c] * spread[c, d] * inverse[d, b]
            out[a, b] = total
