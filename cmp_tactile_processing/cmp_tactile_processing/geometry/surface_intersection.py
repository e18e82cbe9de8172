"""Where rays meet the undeformed marker surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.sensor.parts import PatternSurface

__all__ = ["surface_intersection"]


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
