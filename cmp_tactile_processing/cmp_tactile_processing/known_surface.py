"""Where the rays of one view meet the known surface: all that a monocular sensor can tell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.markers_3d import MarkerFault
from cmp_tactile_processing.pattern import PatternSurface
from cmp_tactile_processing.ray_kernels import RayBundle
from cmp_tactile_processing.triangulation import Triangulated

__all__ = ["meet_surface", "surface_intersection"]


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


def surface_intersection(
    origins: NDArray[np.float64], directions: NDArray[np.float64], surface: PatternSurface
) -> NDArray[np.float64]:
    """Point of the undeformed marker surface on each ray from below, (..., 3) m, gel frame.

    NaN where a ray misses the surface or is NaN.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        if surface.type == "plane":
            t = -origins[..., 2] / directions[..., 2]
        else:
            # The circle or sphere about (0, 0, -R), left by a ray through its upper half.
            curved = (
                [0, 1, 2] if surface.type == "sphere_cap" else [{"x": 1, "y": 0}[surface.axis], 2]
            )
            o, d = (origins + [0.0, 0.0, surface.radius])[..., curved], directions[..., curved]
            a, b = (d * d).sum(axis=-1), (o * d).sum(axis=-1)
            c = (o * o).sum(axis=-1) - surface.radius**2
            t = (-b + np.sqrt(b * b - a * c)) / a
        points = origins + t[..., None] * directions
        points[~((t > 0) & (points[..., 2] >= -surface.radius))] = np.nan
    return np.asarray(points)
