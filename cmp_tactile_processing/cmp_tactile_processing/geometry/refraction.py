"""Flat refracting layers perpendicular to the gel's z axis (Snell's law).

Along a ray n sin(angle to z) is the same in all layers.  A ray is told here by t, the tangent of
its angle in air: unlike the sine it keeps its digits towards grazing.  In a layer of index n >= 1
the tangent is

    tan = t / w,   w^2 = n^2 + (n^2 - 1) t^2,   d tan / dt = n^2 / w^3,

so the distance from the camera's vertical that a ray reaches, the sum of depth tan over the
layers, is an increasing, concave function of t: Newton's method from below finds its root from
below, always.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.sensor.parts import RefractingLayer

__all__ = ["apparent_points", "apparent_points_with_jacobian", "refract_rays"]

NEWTON_STEPS = 50
# Newton's method squares the relative error: a step of this size leaves rounding only.
LAST_STEP = 1e-9


def refract_rays(
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    layers: tuple[RefractingLayer, ...],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays behind all layers, for rays (N, 3), (N, 3) in air from below them, gel frame.

    Directions stay unit.  Rows become NaN where a ray never reaches a layer, starts behind it or
    is totally reflected.
    """
    index = 1.0
    for layer in layers:
        ahead = np.where(directions[:, 2:] > 0, directions[:, 2:], np.nan)
        t = (layer.z - origins[:, 2:]) / ahead
        across = directions[:, :2] * (index / layer.index)
        along2 = 1 - (across * across).sum(axis=1, keepdims=True)
        passes = (t >= 0) & (along2 > 0)
        origins = np.where(passes, origins + t * directions, np.nan)
        refracted = np.concatenate([across, np.sqrt(np.where(passes, along2, np.nan))], axis=1)
        directions = np.where(passes, refracted, np.nan)
        index = layer.index
    return origins, directions


def apparent_points(
    centre: NDArray[np.float64], points: NDArray[np.float64], layers: tuple[RefractingLayer, ...]
) -> NDArray[np.float64]:
    """Points at which rays from the camera centre must aim, in air, to reach `points`.

    centre (3,), points (N, 3), gel frame, m; centre below all layers, all indices at least 1.
    Returns (N, 3): on the ray in air, at the depth of the point.  The ray that is found passes
    the point within the rounding of its coordinates, grazing rays too.
    """
    if not layers:
        return points
    return _seen_along(centre, points, _Path.to_points(centre, points, layers))


def apparent_points_with_jacobian(
    centre: NDArray[np.float64], points: NDArray[np.float64], layers: tuple[RefractingLayer, ...]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What `apparent_points` gives, and its derivatives (N, 3, 3) by the points.

    By the implicit function theorem: where reach(t, z) = distance, dt = (d distance -
    tan dz) / (d reach / dt), with the tangent in the layer of the point.
    """
    J = np.tile(np.eye(3), (len(points), 1, 1))
    J[np.isnan(points).any(axis=1)] = np.nan
    if not layers:
        return points, J
    path = _Path.to_points(centre, points, layers)
    t, height, distance = path.t[:, None], path.height[:, None], path.distance[:, None]
    slope, tangent = path.derivatives()
    unit = np.divide(path.offset, distance, out=np.zeros_like(path.offset), where=distance > 0)
    # t / distance -> 1 / (d reach / dt) on the axis, in all directions.
    around = np.divide(t, distance, out=1 / slope, where=distance > 0)
    outward = unit[:, :, None] * unit[:, None, :]
    across = (1 / slope - around)[:, :, None] * outward + around[:, :, None] * np.eye(2)
    bent = path.height > 0
    J[bent, :2, :2] = (height[:, :, None] * across)[bent]
    J[bent, :2, 2] = (unit * (t - height * tangent / slope))[bent]
    return _seen_along(centre, points, path), J


@dataclass(frozen=True)
class _Path:
    """Ways from the camera to N points.

    offset (N, 2), distance (N,), height (N,): the points from the camera, m.  indices (L + 1,), air
    first; depth (N, L + 1): how much of each lies below the point, m.  t (N,): tangent in air, NaN
    for points that are not above the camera.
    """

    offset: NDArray[np.float64]
    distance: NDArray[np.float64]
    height: NDArray[np.float64]
    indices: NDArray[np.float64]
    depth: NDArray[np.float64]
    t: NDArray[np.float64]

    @classmethod
    def to_points(
        cls,
        centre: NDArray[np.float64],
        points: NDArray[np.float64],
        layers: tuple[RefractingLayer, ...],
    ) -> _Path:
        offset = points[:, :2] - centre[:2]
        distance = np.hypot(offset[:, 0], offset[:, 1])
        indices = np.array([1.0, *(layer.index for layer in layers)])
        edges = np.array([centre[2], *(layer.z for layer in layers), np.inf])
        depth = np.diff(np.minimum(edges, points[:, 2:]), axis=1)
        t = _air_tangent(indices, depth, distance)
        return cls(offset, distance, points[:, 2] - centre[2], indices, depth, t)

    def derivatives(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Of the reach, (N, 1) each: by t, and by the height of the point."""
        w2 = self.indices**2 + (self.indices**2 - 1) * (self.t * self.t)[:, None]
        by_t = (self.depth * self.indices**2 / w2**1.5).sum(axis=1, keepdims=True)
        last = np.maximum((self.depth > 0).sum(axis=1, keepdims=True) - 1, 0)
        return by_t, self.t[:, None] / np.sqrt(np.take_along_axis(w2, last, axis=1))


def _seen_along(
    centre: NDArray[np.float64], points: NDArray[np.float64], path: _Path
) -> NDArray[np.float64]:
    """Points at the height of `points` on the rays in air."""
    scale = np.divide(
        path.t * path.height, path.distance, out=np.ones_like(path.t), where=path.distance > 0
    )
    # Straight through the air to what lies beside or below the camera.
    scale[path.height <= 0] = 1.0
    return np.concatenate([centre[:2] + path.offset * scale[:, None], points[:, 2:]], axis=1)


def _air_tangent(
    indices: NDArray[np.float64], depth: NDArray[np.float64], distance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Tangent (N,) in air of the rays that reach these distances through these depths."""
    total = depth.sum(axis=1)
    target = np.where(total > 0, distance, np.nan)
    excess = indices**2 - 1
    # Two bounds from below: the layers as thin as they look straight on, and as wide as a grazing
    # ray crosses them.
    t = target / (depth @ (1 / indices))
    widest = depth[:, 1:] @ (1 / np.sqrt(np.maximum(excess[1:], 1e-30)))
    t = np.maximum(t, (target - widest) / depth[:, 0])
    for _ in range(NEWTON_STEPS):
        w2 = indices**2 + excess * (t * t)[:, None]
        part = depth / np.sqrt(w2)
        step = (target - t * part.sum(axis=1)) / (part / w2 @ indices**2)
        t = t + step
        if not (np.abs(step) > LAST_STEP * t).any():
            break
    return t
