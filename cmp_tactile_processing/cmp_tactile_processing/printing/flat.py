"""The marker surface laid flat: where a point of the gel lies on the flat print."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.sensor.parts import PatternSurface

__all__ = ["PROCESSES", "default_process", "flat_print", "rim_strain"]

# along_axis: the print arrives along the gel's z axis (pad or transfer printing, exposure from
# above).  unrolled: a film is printed flat and laid around the gel.
PROCESSES = ("along_axis", "unrolled")


def default_process(surface: PatternSurface) -> str:
    """What gives the true pattern with the least equipment.

    A cylinder unrolls without any stretch, so a film that is laid around it is exact.  A film on
    a sphere wrinkles, so there the print is to arrive along the axis; on a plane both are one.
    """
    return "unrolled" if surface.type == "cylinder" else "along_axis"


def flat_print(
    surface: PatternSurface, process: str, xy: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Places (..., 2) m on the flat print of points (..., 2) m, x and y of the gel frame.

    The apex lies at (0, 0), axes along the gel's.  along_axis: the same x and y.  unrolled: arc
    length R asin(x / R) across a cylinder; on a sphere the distance from the apex, measured on the
    surface, in the direction of the point (azimuthal equidistant).  NaN beyond the surface.
    """
    xy = np.array(xy, dtype=np.float64)
    if process == "along_axis" or surface.type == "plane":
        return xy
    radius = surface.radius
    if surface.type == "cylinder":
        across = 1 if surface.axis == "x" else 0
        with np.errstate(invalid="ignore"):
            xy[..., across] = radius * np.arcsin(xy[..., across] / radius)
        return xy
    distance = np.hypot(xy[..., 0], xy[..., 1])
    with np.errstate(invalid="ignore"):
        arc = radius * np.arcsin(distance / radius)
    growth = np.divide(arc, distance, out=np.ones_like(arc), where=distance > 0)
    return xy * growth[..., None]


def rim_strain(surface: PatternSurface, process: str, xy: NDArray[np.float64]) -> float:
    """Greatest strain along the rim of a film that is laid on the gel, over points (..., 2) m.

    A circle of arc t R about a sphere's apex is 2 pi R sin(t) long, on the flat film 2 pi R t: the
    film is pushed together along it by 1 - sin(t) / t.  Negative, then; 0 on what unrolls.
    """
    if process == "along_axis" or surface.type != "sphere_cap":
        return 0.0
    farthest = float(np.hypot(xy[..., 0], xy[..., 1]).max()) / surface.radius
    return farthest / float(np.arcsin(farthest)) - 1 if farthest > 0 else 0.0
