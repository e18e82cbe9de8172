"""How deep a dent seems that markers lie around: the deepest marker, and what a fit makes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.surface import Surface

__all__ = ["CapturedDepth", "Dents", "Neighbourhood", "captured_depth", "dents_of", "fitted_depth"]

# A polynomial is sought for its deepest place on so many lines either way.
SEARCH_LINES = 41

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Dents:
    """Known markers: material coordinates xy (n, 2) m, depth (n,) m against the gel at rest."""

    xy: Array
    depth: Array


@dataclass(frozen=True)
class Neighbourhood:
    """Which markers a polynomial is fitted to.

    half: of the side of a square around the deepest marker, m.  nearest: or so many markers,
    where it is not 0.
    """

    half: float
    nearest: int = 0

    def of(self, dents: Dents, centre: Array) -> NDArray[np.bool_]:
        """Which markers lie in it."""
        away = dents.xy - centre
        if self.nearest:
            distance = np.linalg.norm(away, axis=1)
            limit = np.sort(distance)[min(self.nearest, len(distance)) - 1]
            return np.asarray(distance <= limit + 1e-9)
        return np.asarray((np.abs(away) <= self.half + 1e-9).all(axis=1))


@dataclass(frozen=True)
class CapturedDepth:
    """depth: of the deepest marker, m.  fitted: deepest place of the polynomial, m."""

    depth: float
    fitted: float


def dents_of(surface: Surface, at_rest: Sequence[Surface], material: Surface) -> Dents:
    """Depths of all known markers of a surface.

    at_rest: as measured of the gel at rest; their mean is what depth is measured from.
    material: the exact markers at rest, whose x and y are the material coordinates.
    """
    depths, places = [], []
    for name in ("position", "row_position", "col_position"):
        rest = np.mean([getattr(item, name)[..., 2] for item in at_rest], axis=0)
        depths.append((rest - getattr(surface, name)[..., 2]).ravel())
        places.append(getattr(material, name)[..., :2].reshape(-1, 2))
    depth, xy = np.concatenate(depths), np.concatenate(places)
    known = np.isfinite(depth)
    return Dents(xy[known], depth[known])


def captured_depth(
    dents: Dents, around: tuple[float, float], reach: float, neighbourhood: Neighbourhood
) -> CapturedDepth:
    """What the markers within `reach`, m, of a place (x, y) m tell of the dent there."""
    near = np.linalg.norm(dents.xy - around, axis=1) <= reach
    if not near.any():
        return CapturedDepth(float("nan"), float("nan"))
    deepest = int(np.argmax(np.where(near, dents.depth, -np.inf)))
    fitted = fitted_depth(dents, dents.xy[deepest], neighbourhood)
    return CapturedDepth(float(dents.depth[deepest]), fitted)


def fitted_depth(dents: Dents, centre: Array, neighbourhood: Neighbourhood) -> float:
    """Deepest place, m, of the quadratic in x and y through the markers around a centre (2,) m.

    Least squares; where the markers do not determine all six terms, the flattest of what fits.
    It is sought half as far from the centre, along x and along y, as the markers reach.
    """
    inside = neighbourhood.of(dents, centre)
    away = dents.xy[inside] - centre
    reach = np.abs(away).max(axis=0)
    scale = reach.max()
    if scale <= 0:
        return float("nan")
    terms = np.linalg.lstsq(_quadratic(away / scale), dents.depth[inside], rcond=1e-6)[0]
    line = np.linspace(-0.5, 0.5, SEARCH_LINES)
    places = np.stack(np.meshgrid(*(line * side / scale for side in reach)), axis=-1)
    return float((_quadratic(places.reshape(-1, 2)) @ terms).max())


def _quadratic(xy: Array) -> Array:
    x, y = xy.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
