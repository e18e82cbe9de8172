"""Sub-pixel centres of dots in an image of darkness, and what their outlines look like."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["Outlines", "centroids", "outlines", "peaks"]

# Passes in which the window moves to the centre that the last one found.
PASSES = 4
# The window's rim fades over this share of its radius, so that no pixel enters it at once.
FADE = 0.25
# Directions in which a dot's edge is looked for, and how far, in radii.
DIRECTIONS = 24
REACH = 1.9
STEPS = 40


@dataclass(frozen=True)
class Outlines:
    """Ellipses through the edges of N dots.

    centre (N, 2) px; area (N,) px^2; elongation (N,): longer over shorter axis where the nominal
    foreshortening is taken out; residual (N,): RMS distance of the edge from the ellipse, in mean
    radii.  NaN where the edge is not closed.
    """

    centre: NDArray[np.float64]
    area: NDArray[np.float64]
    elongation: NDArray[np.float64]
    residual: NDArray[np.float64]


def peaks(response: NDArray[np.float32], at: NDArray[np.intp]) -> NDArray[np.float64]:
    """Tops (N, 2) px of the quadratic surfaces through 3 x 3 pixels around at (N, 2), as (x, y)."""
    x, y = at.T
    z = [[response[y + dy, x + dx].astype(np.float64) for dx in (-1, 0, 1)] for dy in (-1, 0, 1)]
    slope_x = sum(row[2] - row[0] for row in z) / 6
    slope_y = sum(z[2][k] - z[0][k] for k in range(3)) / 6
    bend_x = sum(row[2] - 2 * row[1] + row[0] for row in z) / 3
    bend_y = sum(z[2][k] - 2 * z[1][k] + z[0][k] for k in range(3)) / 3
    twist = (z[2][2] - z[2][0] - z[0][2] + z[0][0]) / 4
    determinant = bend_x * bend_y - twist**2
    with np.errstate(divide="ignore", invalid="ignore"):
        off_x = (twist * slope_y - bend_y * slope_x) / determinant
        off_y = (twist * slope_x - bend_x * slope_y) / determinant
    off = np.stack([off_x, off_y], axis=-1)
    good = (determinant > 0) & (np.abs(off) < 1).all(axis=1)
    return np.asarray(at + np.where(good[:, None], off, 0.0), dtype=np.float64)


def centroids(
    darkness: NDArray[np.float32],
    start: NDArray[np.float64],
    to_radii: NDArray[np.float64],
    threshold: float,
    window: float,
) -> NDArray[np.float64]:
    """Darkness-weighted centroids (N, 2) px; NaN where nothing dark is.

    darkness (H, W): 0 for skin, 1 for ink.  start (N, 2) px.  to_radii (N, 2, 2): from px to radii
    of a dot as it is foreshortened there.  threshold: what is subtracted from the darkness before
    it weighs.  window: radius of what counts, in radii.
    """
    return np.asarray(
        _centroids(
            darkness,
            np.ascontiguousarray(start, dtype=np.float64),
            np.ascontiguousarray(to_radii),
            (threshold, window),
        )
    )


def outlines(
    darkness: NDArray[np.float32],
    centre: NDArray[np.float64],
    to_radii: NDArray[np.float64],
    level: float = 0.5,
) -> Outlines:
    """Edges of dots around centres (N, 2) px where the darkness falls to a level, and ellipses."""
    from_radii = np.linalg.inv(to_radii)
    angle = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rays = np.einsum("nij,kj->nki", from_radii, circle)
    reach = _edges(darkness, np.ascontiguousarray(centre), np.ascontiguousarray(rays), level)
    # In radii of the undeformed dot, so that all are of one size.
    edge = reach[..., None] * circle
    off, axes, residual = _ellipses(edge)
    scale = np.abs(np.linalg.det(from_radii))
    return Outlines(
        centre=centre + np.einsum("nij,nj->ni", from_radii, off),
        area=np.pi * axes[:, 0] * axes[:, 1] * scale,
        elongation=axes[:, 1] / axes[:, 0],
        residual=residual,
    )


@njit(cache=True, nogil=True)
def _centroids(
    darkness: NDArray[np.float32],
    start: NDArray[np.float64],
    to_radii: NDArray[np.float64],
    limits: tuple[float, float],
) -> NDArray[np.float64]:
    threshold, window = limits
    height, width = darkness.shape
    found = np.empty_like(start)
    for n in range(len(start)):
        x0, y0 = start[n]
        a, b, c, d = to_radii[n, 0, 0], to_radii[n, 0, 1], to_radii[n, 1, 0], to_radii[n, 1, 1]
        determinant = abs(a * d - b * c)
        # Half the sides of the box around the window.
        reach_x = window * np.sqrt(b * b + d * d) / determinant
        reach_y = window * np.sqrt(a * a + c * c) / determinant
        for _ in range(PASSES):
            total, sum_x, sum_y = 0.0, 0.0, 0.0
            for y in range(max(int(y0 - reach_y), 0), min(int(y0 + reach_y) + 2, height)):
                for x in range(max(int(x0 - reach_x), 0), min(int(x0 + reach_x) + 2, width)):
                    u, v = a * (x - x0) + b * (y - y0), c * (x - x0) + d * (y - y0)
                    inside = (window - np.sqrt(u * u + v * v)) / (FADE * window)
                    if inside <= 0:
                        continue
                    weight = min(inside, 1.0) * max(darkness[y, x] - threshold, 0.0)
                    total += weight
                    sum_x += weight * x
                    sum_y += weight * y
            if total <= 0:
                x0, y0 = np.nan, np.nan
                break
            x0, y0 = sum_x / total, sum_y / total
        found[n, 0], found[n, 1] = x0, y0
    return found


@njit(cache=True, nogil=True)
def _edges(
    darkness: NDArray[np.float32],
    centre: NDArray[np.float64],
    rays: NDArray[np.float64],
    level: float,
) -> NDArray[np.float64]:
    """How far along each ray (N, K, 2) px the darkness first falls to the level; NaN if nowhere."""
    height, width = darkness.shape
    found = np.full(rays.shape[:2], np.nan)
    for n in range(len(centre)):
        for k in range(rays.shape[1]):
            last = 2.0
            for step in range(STEPS + 1):
                reach = 0.2 + step * (REACH - 0.2) / STEPS
                x, y = centre[n, 0] + reach * rays[n, k, 0], centre[n, 1] + reach * rays[n, k, 1]
                if not (0 <= x < width - 1 and 0 <= y < height - 1):
                    break
                col, row = int(x), int(y)
                u, v = x - col, y - row
                upper = darkness[row, col] * (1 - u) + darkness[row, col + 1] * u
                lower = darkness[row + 1, col] * (1 - u) + darkness[row + 1, col + 1] * u
                value = upper * (1 - v) + lower * v
                if value < level:
                    if step > 0:
                        back = (level - value) / (last - value)
                        found[n, k] = reach - back * (REACH - 0.2) / STEPS
                    break
                last = value
    return found


def _ellipses(
    edge: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Centre (N, 2), half axes (N, 2), shorter first, and residual (N,) of points (N, K, 2).

    Conics a x^2 + b x y + c y^2 + d x + e y = 1, which do for outlines around the origin.
    """
    count = len(edge)
    centre, axes = np.full((count, 2), np.nan), np.full((count, 2), np.nan)
    residual = np.full(count, np.nan)
    closed = np.asarray(np.isfinite(edge).all(axis=(1, 2)))
    x, y = edge[closed, :, 0], edge[closed, :, 1]
    design = np.stack([x * x, x * y, y * y, x, y], axis=-1)
    transposed = design.swapaxes(1, 2)
    conic = np.linalg.solve(
        transposed @ design + 1e-12 * np.eye(5), transposed.sum(axis=2)[..., None]
    )[..., 0]
    matrix = np.empty((len(conic), 2, 2))
    matrix[:, 0, 0], matrix[:, 1, 1] = conic[:, 0], conic[:, 2]
    matrix[:, 0, 1] = matrix[:, 1, 0] = conic[:, 1] / 2
    good = np.linalg.det(matrix) > 1e-9
    closed[closed] = good
    matrix, conic, points = matrix[good], conic[good], edge[closed]
    middle = -np.linalg.solve(matrix, conic[:, 3:, None])[..., 0] / 2
    level = 1 + np.einsum("ni,nij,nj->n", middle, matrix, middle)
    values, vectors = np.linalg.eigh(matrix)
    with np.errstate(invalid="ignore"):
        half = np.sqrt(level[:, None] / values)
    along = np.einsum("nij,nki->nkj", vectors, points - middle[:, None]) / half[:, None]
    centre[closed], axes[closed] = middle, half[:, ::-1]
    residual[closed] = np.sqrt(np.mean((np.linalg.norm(along, axis=-1) - 1) ** 2, axis=1))
    return centre, axes, residual
