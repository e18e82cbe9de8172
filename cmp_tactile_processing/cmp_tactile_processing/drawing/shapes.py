"""Arrows, outlines and triangles as arrays of points, NaN left out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

HEAD_LENGTH, HEAD_HALF_WIDTH = 0.25, 0.1
# Arrows shorter than this, as drawn, would only be dots.
SHORTEST_ARROW_M = 2e-5
# The arc around the arrow of a moment: its radius and place in lengths of the arrow.
TURN_RADIUS, TURN_PLACE, TURN_SIDES = 0.35, 0.5, 18
TURN_ANGLE = 1.5 * np.pi


def arrows(
    tails: NDArray[np.float64],
    vectors: NDArray[np.float64],
    shortest: float = SHORTEST_ARROW_M,
) -> NDArray[np.float64]:
    """Ends (3 A, 2, 3) of shaft and two barbs of each arrow that is finite and over `shortest`.

    tails, vectors: (N, 3).
    """
    length = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    drawn = np.isfinite(tails).all(axis=-1) & (length > shortest)
    tails, vectors, length = tails[drawn], vectors[drawn], length[drawn, None]
    side = np.stack([vectors[:, 1], -vectors[:, 0], np.zeros(len(vectors))], axis=-1)
    across = np.hypot(side[:, 0], side[:, 1])
    # An arrow along z has no side in the xy plane; x serves as well.
    flat = across < 1e-6 * length[:, 0]
    side[flat], across[flat] = (1.0, 0.0, 0.0), 1.0
    side *= HEAD_HALF_WIDTH * length / across[:, None]
    tips = tails + vectors
    back = tips - HEAD_LENGTH * vectors
    ends = np.stack([tails, tips, tips, back + side, tips, back - side], axis=1)
    return ends.reshape(-1, 2, 3)


def turning_arrow(centre: NDArray[np.float64], vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ends (S, 2, 3) of an arrow along the axis (3,) of a moment, and an arc in its sense.

    It stands on `centre` (3,), on the side of greater z, and is empty where not finite or tiny.
    """
    tail = centre if vector[2] >= 0 else centre - vector
    shaft = arrows(tail[None], vector[None])
    if not len(shaft):
        return shaft
    length = np.linalg.norm(vector)
    axis = vector / length
    across = np.cross(axis, (0.0, 0.0, 1.0) if abs(axis[2]) < 0.9 else (1.0, 0.0, 0.0))
    across /= np.linalg.norm(across)
    angle = np.linspace(0.0, TURN_ANGLE, TURN_SIDES + 1)[:, None]
    radius = TURN_RADIUS * length
    arc = radius * (np.cos(angle) * across + np.sin(angle) * np.cross(axis, across))
    arc += tail + TURN_PLACE * vector
    sides = np.stack([arc[:-1], arc[1:]], axis=1)
    along = arc[-1] - arc[-2]
    along *= 2 * radius / np.linalg.norm(along)
    barbs = arrows(arc[-1:] - along, along[None])[1:]
    return np.concatenate([shaft, sides, barbs])


def closed(outline: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sides (S, 2, 3) of a closed polygon (S, 3), those with NaN left out."""
    sides = np.stack([outline, np.roll(outline, -1, axis=0)], axis=1)
    return np.asarray(sides[np.isfinite(sides).all(axis=(1, 2))])


def mesh_vertices(known: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Numbers of grid points, three a triangle, that face +z where rows go +y and columns +x.

    known (rows, cols): a cell of the grid has two triangles if all its corners are known.
    """
    number = np.arange(known.size).reshape(known.shape)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    whole = known[:-1, :-1] & known[:-1, 1:] & known[1:, 1:] & known[1:, :-1]
    return np.stack([a, b, c, a, c, d], axis=-1)[whole].ravel()
