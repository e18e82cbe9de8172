"""Sub-pixel position of checker corners: the saddle point of a quadratic fitted to the image."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from cmp_tactile_processing.prepared_image import PreparedImage

__all__ = ["SaddlePointFit", "SaddlePoints", "refine_saddle_points"]

ITERATIONS, OLD_CONVERGED_PX = 5, 0.03
# The window moves at most so often, and has arrived when it would move by less than this, px.
MOST_STEPS, CONVERGED_PX = 12, 0.02


@dataclass(frozen=True)
class SaddlePoints:
    """position (n, 2) px, NaN where the fit failed; hessian (n, 3): xx, xy, yy, grey / px^2;
    std (n,): standard deviation of the position, px per coordinate.
    """

    position: NDArray[np.float64]
    hessian: NDArray[np.float64]
    std: NDArray[np.float64]


# Half the width of the window, in checker sides and at least.  Its weights fall to zero there.
WINDOW_PER_SIDE, LEAST_WINDOW_PX, MOST_WINDOW_PX = 0.3, 2.2, 12.0
# Error that remains without noise, px per coordinate.
BIAS_PX = 0.006


class SaddlePointFit:
    """Finds saddle points near given starts.

    side_px: side of a checker, which limits the window to the surroundings of one corner.
    """

    def __init__(self, side_px: float) -> None:
        self._reach = float(np.clip(WINDOW_PER_SIDE * side_px, LEAST_WINDOW_PX, MOST_WINDOW_PX))

    def fit(
        self, image: PreparedImage, start: NDArray[np.float64], reach_px: ArrayLike
    ) -> SaddlePoints:
        """Saddle points near `start` (n, 2) px; reach_px () or (n,): how far each may lie from it.

        A quadratic is fitted by weighted least squares in a window, which moves to the quadratic's
        stationary point until it stands still.  The weights move with the window by fractions of
        a pixel and fall to zero at its border: a window that stayed on whole pixels would bias the
        point towards them.  NaN where there is no saddle, where the search leaves the image, goes
        farther than `reach_px` from the start or does not converge.
        """
        n = len(start)
        first = np.ascontiguousarray(start, dtype=np.float64)
        reach = np.ascontiguousarray(np.broadcast_to(reach_px, n), dtype=np.float64)
        result = SaddlePoints(np.empty((n, 2)), np.empty((n, 3)), np.empty(n))
        error = image.noise * _gradient_gain(self._reach, image.smoothing_px)
        window = (self._reach, error, BIAS_PX)
        _fit(image.smooth, first, reach, window, result.position, result.hessian, result.std)
        return result


@lru_cache(maxsize=64)
def _gradient_gain(window_px: float, smoothing_px: float) -> float:
    """Standard deviation of a component of the fitted gradient per that of the image's noise."""
    reach, blur = int(np.ceil(window_px)), int(np.ceil(4 * smoothing_px))
    t = np.arange(-reach, reach + 1.0)
    weight = np.maximum(1 - (t / window_px) ** 2, 0) ** 2
    gaussian = np.exp(-0.5 * (np.arange(-blur, blur + 1) / max(smoothing_px, 1e-3)) ** 2)
    along = np.convolve(weight * t / (weight * t * t).sum(), gaussian / gaussian.sum())
    across = np.convolve(weight / weight.sum(), gaussian / gaussian.sum())
    return float(np.linalg.norm(along) * np.linalg.norm(across))


@njit(cache=True, nogil=True, inline="always")
def _axis(
    at: float, reach: float, weights: NDArray[np.float64]
) -> tuple[int, int, float, float, float]:
    """Weights (3, m) that fit 1, t - mu and t^2 - alpha t - beta to pixels about `at`.

    Returns the first pixel, how many, mu, alpha.  The three polynomials are orthogonal under the
    window's weights, so that in two directions their products are, too.
    """
    first = int(np.floor(at - reach)) + 1
    count = int(np.ceil(at + reach)) - first
    m0 = m1 = m2 = m3 = m4 = 0.0
    for k in range(count):
        t = first + k - at
        w = 1 - (t / reach) ** 2
        w *= w
        weights[0, k] = w
        m0 += w
        m1 += w * t
        m2 += w * t * t
        m3 += w * t * t * t
        m4 += w * t * t * t * t
    mu = m1 / m0
    norm1 = m2 - mu * m1
    alpha = (m3 - mu * m2) / norm1
    beta = m2 / m0 - alpha * mu
    norm2 = m4 - alpha * m3 - beta * m2
    for k in range(count):
        t = first + k - at
        w = weights[0, k]
        weights[0, k] = w / m0
        weights[1, k] = w * (t - mu) / norm1
        weights[2, k] = w * (t * t - alpha * t - beta) / norm2
    return first, count, mu, alpha, beta


@njit(cache=True, nogil=True)
def _fit(
    image: NDArray[np.float32],
    start: NDArray[np.float64],
    reach: NDArray[np.float64],
    window: tuple[float, float, float],
    position: NDArray[np.float64],
    hessian: NDArray[np.float64],
    std: NDArray[np.float64],
) -> None:
    size, gradient_error, bias = window
    height, width = image.shape
    in_x, in_y = np.empty((3, 32)), np.empty((3, 32))
    for n in range(len(start)):
        position[n], hessian[n], std[n] = np.nan, np.nan, np.nan
        x, y = start[n]
        for _ in range(MOST_STEPS):
            inside = x - size >= 0 and y - size >= 0
            inside = inside and x + size <= width - 1 and y + size <= height - 1
            if not (inside and np.hypot(x - start[n, 0], y - start[n, 1]) <= reach[n]):
                break
            left, columns, mu_x, alpha_x, _ = _axis(x, size, in_x)
            top, rows, mu_y, alpha_y, _ = _axis(y, size, in_y)
            c10 = c01 = c20 = c11 = c02 = 0.0
            for i in range(rows):
                s0 = s1 = s2 = np.float32(0.0)
                for j in range(columns):
                    value = image[top + i, left + j]
                    s0 += in_x[0, j] * value
                    s1 += in_x[1, j] * value
                    s2 += in_x[2, j] * value
                c10 += in_y[0, i] * s1
                c20 += in_y[0, i] * s2
                c01 += in_y[1, i] * s0
                c11 += in_y[1, i] * s1
                c02 += in_y[2, i] * s0
            slope_x = c10 - alpha_x * c20 - mu_y * c11
            slope_y = c01 - alpha_y * c02 - mu_x * c11
            determinant = 4 * c20 * c02 - c11 * c11
            if not determinant < 0:
                break
            dx = (c11 * slope_y - 2 * c02 * slope_x) / determinant
            dy = (c11 * slope_x - 2 * c20 * slope_y) / determinant
            far = np.hypot(dx, dy)
            shorten = min(1.0, 0.5 * size / max(far, 1e-12))
            x += shorten * dx
            y += shorten * dy
            if far < CONVERGED_PX:
                if np.hypot(x - start[n, 0], y - start[n, 1]) <= reach[n]:
                    position[n, 0], position[n, 1] = x, y
                    hessian[n, 0], hessian[n, 1], hessian[n, 2] = 2 * c20, c11, 2 * c02
                    gain = np.sqrt((4 * c20**2 + 4 * c02**2 + 2 * c11**2) / 2) / -determinant
                    std[n] = np.hypot(gradient_error * gain, bias)
                break


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
        alive = np.flatnonzero(np.isfinite(position[:, 0]) & (step > OLD_CONVERGED_PX / 3))
        if not len(alive):
            break
        window = _interpolated(smooth, position[alive], radius)[:, inside]
        move, hessian[alive] = _stationary_points(window, solve)
        position[alive] += move
        step[alive] = np.linalg.norm(move, axis=1)
    position[~(step <= OLD_CONVERGED_PX)] = np.nan
    return SaddlePoints(position, hessian, np.full(len(start), np.nan))


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
