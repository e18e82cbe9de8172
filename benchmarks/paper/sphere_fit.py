"""The sphere nearest to points, as section V.B fits one to markers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

__all__ = ["SphereFit", "fit_sphere"]

LEAST_POINTS = 4
# In units of the points' spread; so flat that no ball of the experiment comes near to it.
FLATTEST = 1e3


@dataclass(frozen=True)
class SphereFit:
    """centre (3,) and diameter, in the points' unit; rms: of the points' distances from it.

    count: points.  NaN throughout where the points bear no sphere.
    """

    centre: NDArray[np.float64]
    diameter: float
    rms: float
    count: int


def fit_sphere(points: NDArray[np.float64]) -> SphereFit:
    """The sphere with the least sum of squared distances to points (n, 3); NaN rows are left out.

    Geometric, not algebraic: noise on a small cap makes an algebraic fit's sphere too small.
    NaN for fewer than four points and for points that are all but flat.
    """
    points = points[np.isfinite(points).all(axis=-1)]
    none = SphereFit(np.full(3, np.nan), float("nan"), float("nan"), len(points))
    if len(points) < LEAST_POINTS:
        return none
    middle = points.mean(axis=0)
    scale = float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean()))
    if scale == 0:
        return none
    unit = (points - middle) / scale
    start = _algebraic(unit)
    if start is None:
        return none
    found = least_squares(_distances, start, _gradient, args=(unit,), method="lm", xtol=1e-12)
    radius = abs(float(found.x[3]))
    if not found.success or radius > FLATTEST:
        return none
    rms = float(np.sqrt(np.mean(found.fun**2)))
    return SphereFit(middle + scale * found.x[:3], 2 * scale * radius, scale * rms, len(points))


def _algebraic(points: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Centre and radius from the linear equations |p|^2 = 2 c . p + r^2 - |c|^2."""
    design = np.column_stack([2 * points, np.ones(len(points))])
    solution, _, rank, _ = np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)
    if rank < design.shape[1]:
        return None
    squared = solution[3] + solution[:3] @ solution[:3]
    return np.array([*solution[:3], np.sqrt(squared)])


def _distances(sphere: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(points - sphere[:3], axis=1) - sphere[3])


def _gradient(sphere: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    off = points - sphere[:3]
    return np.column_stack(
        [-off / np.linalg.norm(off, axis=1, keepdims=True), -np.ones(len(points))]
    )
