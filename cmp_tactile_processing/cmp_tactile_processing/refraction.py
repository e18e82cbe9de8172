"""Flat refracting layers perpendicular to the gel's z axis (Snell's law)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.sensor_description import RefractingLayer

__all__ = ["apparent_points", "refract_rays"]

NEWTON_STEPS = 30


def refract_rays(
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    layers: tuple[RefractingLayer, ...],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays behind all layers, for rays (N, 3), (N, 3) in air that travel towards +z, gel frame.

    Directions stay unit; rows become NaN where a ray never reaches a layer.
    """
    index = 1.0
    for layer in layers:
        with np.errstate(invalid="ignore", divide="ignore"):
            ahead = np.where(directions[:, 2:] > 0, directions[:, 2:], np.nan)
            t = (layer.z - origins[:, 2:]) / ahead
            origins = origins + t * directions
            across = directions[:, :2] * (index / layer.index)
            along = np.sqrt(1 - (across**2).sum(axis=1, keepdims=True)) * np.sign(ahead)
        directions = np.concatenate([across, along], axis=1)
        index = layer.index
    return origins, directions


def apparent_points(
    centre: NDArray[np.float64], points: NDArray[np.float64], layers: tuple[RefractingLayer, ...]
) -> NDArray[np.float64]:
    """Points at which rays from the camera centre must aim, in air, to reach `points`.

    centre (3,), points (N, 3), gel frame, m.  Returns (N, 3): on the ray in air, at the depth of
    the point.  Solves the one unknown of Snell's law, n sin(angle), by Newton's method.
    """
    if not layers:
        return points
    indices = np.array([1.0, *(layer.index for layer in layers)])
    planes = np.array([layer.z for layer in layers])
    offset = points[:, :2] - centre[:2]
    distance = np.linalg.norm(offset, axis=1)
    edges = np.concatenate([[centre[2]], planes, [np.inf]])
    depth = np.minimum(edges[1:], points[:, 2:]) - np.minimum(edges[:-1], points[:, 2:])
    total = depth.sum(axis=1)

    s = distance / np.hypot(distance, total)
    limit = indices[: len(indices)].min() * (1 - 1e-12)
    for _ in range(NEWTON_STEPS):
        along = np.sqrt(indices**2 - s[:, None] ** 2)
        reach = (depth * s[:, None] / along).sum(axis=1)
        slope = (depth * indices**2 / along**3).sum(axis=1)
        s = np.clip(s - (reach - distance) / slope, 0.0, limit)
    tangent = s / np.sqrt(1 - s**2)
    scale = np.divide(tangent * total, distance, out=np.ones_like(distance), where=distance > 0)
    return np.concatenate([centre[:2] + offset * scale[:, None], points[:, 2:]], axis=1)
