"""Sub-pixel position of checker corners: the saddle point of a quadratic fitted to the image."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

__all__ = ["SaddlePoints", "refine_saddle_points"]

ITERATIONS = 5
# A fit whose last step is longer than this has not converged, px.
CONVERGED_PX = 0.03


@dataclass(frozen=True)
class SaddlePoints:
    """position (n, 2) px, NaN where the fit failed; hessian (n, 3): xx, xy, yy, grey / px^2."""

    position: NDArray[np.float64]
    hessian: NDArray[np.float64]


def refine_saddle_points(
    smooth: NDArray[np.float32], start: NDArray[np.float64], radius: int, reach_px: float
) -> SaddlePoints:
    """Saddle points of a smoothed image near `start` (n, 2) px.

    Fits z = c0 + c1 x + c2 y + c3 x^2 + c4 xy + c5 y^2 by least squares over a round window and
    moves the window, by fractions of a pixel, to the stationary point of the fit; a window that
    stayed on whole pixels would bias the point towards them.  NaN where there is no saddle, where
    the search leaves the image, goes farther than reach_px from the start or does not converge.
    """
    position = np.array(start, dtype=np.float64)
    hessian = np.full((len(start), 3), np.nan)
    step = np.full(len(start), np.inf)
    inside, solve = _window(radius)
    for _ in range(ITERATIONS):
        with np.errstate(invalid="ignore"):
            near = np.linalg.norm(position - start, axis=1) <= reach_px
        position[~(near & _in_image(position, radius + 2, smooth.shape))] = np.nan
        alive = np.flatnonzero(np.isfinite(position[:, 0]) & (step > CONVERGED_PX / 3))
        if not len(alive):
            break
        window = _interpolated(smooth, position[alive], radius)[:, inside]
        move, hessian[alive] = _stationary_points(window, solve)
        position[alive] += move
        step[alive] = np.linalg.norm(move, axis=1)
    position[~(step <= CONVERGED_PX)] = np.nan
    return SaddlePoints(position, hessian)


@lru_cache(maxsize=8)
def _window(radius: int) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Mask of a round window and the matrix (m, 6) that fits the quadratic to its m pixels."""
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    inside = x**2 + y**2 <= (radius + 0.3) ** 2
    x, y = x[inside], y[inside]
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    return inside, np.linalg.pinv(terms.astype(np.float64)).T.astype(np.float32)


def _in_image(
    position: NDArray[np.float64], margin: int, shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    limit = np.array([shape[1], shape[0]]) - 1 - margin
    with np.errstate(invalid="ignore"):
        return np.asarray(((position >= margin) & (position <= limit)).all(axis=1))


def _interpolated(
    smooth: NDArray[np.float32], position: NDArray[np.float64], radius: int
) -> NDArray[np.float32]:
    """Windows (n, 2 r + 1, 2 r + 1) about sub-pixel positions, by Keys' cubic convolution.

    The fraction is the same for all pixels of a window, so four weights a direction serve all;
    cv2.remap would round the fraction to 1/32 px, which is ten times the error aimed at.
    """
    size = 2 * radius + 1
    corner = np.floor(position).astype(np.intp)
    span = np.arange(-radius - 1, radius + 3)
    x, y = corner[:, :1] + span, corner[:, 1:] + span
    block = smooth[y[:, :, None], x[:, None, :]]
    weight = _keys_weights((position - corner).astype(np.float32))
    rows = sum(block[:, :, k : k + size] * weight[:, 0, k, None, None] for k in range(4))
    windows = sum(rows[:, k : k + size] * weight[:, 1, k, None, None] for k in range(4))
    return np.asarray(windows, dtype=np.float32)


def _keys_weights(t: NDArray[np.float32]) -> NDArray[np.float32]:
    """Weights (..., 4) of the samples at -1, 0, 1, 2 for the fraction t (Keys 1981, a = -1/2)."""
    return np.stack(
        [
            ((-t + 2) * t - 1) * t / 2,
            (3 * t - 5) * t * t / 2 + 1,
            ((-3 * t + 4) * t + 1) * t / 2,
            (t - 1) * t * t / 2,
        ],
        axis=-1,
    )


def _stationary_points(
    window: NDArray[np.float32], solve: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Saddle relative to each window's centre (n, 2) px, NaN without one, and Hessians (n, 3)."""
    c = (window @ solve).astype(np.float64)
    determinant = 4 * c[:, 3] * c[:, 5] - c[:, 4] ** 2
    determinant[~(determinant < 0)] = np.nan
    move = np.stack(
        [c[:, 4] * c[:, 2] - 2 * c[:, 5] * c[:, 1], c[:, 4] * c[:, 1] - 2 * c[:, 3] * c[:, 2]],
        axis=1,
    )
    return move / determinant[:, None], np.stack([2 * c[:, 3], c[:, 4], 2 * c[:, 5]], axis=1)
