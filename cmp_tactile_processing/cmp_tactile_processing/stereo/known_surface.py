"""Where the rays of one view meet the known surface: all that a monocular sensor can tell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.ray_kernels import RayBundle
from cmp_tactile_processing.geometry.surface_intersection import surface_intersection
from cmp_tactile_processing.measured.markers_3d import MarkerFault
from cmp_tactile_processing.sensor.pattern import PatternSurface
from cmp_tactile_processing.stereo.triangulation import Triangulated

__all__ = ["meet_surface"]


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
