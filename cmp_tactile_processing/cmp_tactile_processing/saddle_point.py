"""Sub-pixel position of checker corners: the saddle point of a quadratic fitted to the image."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmp_tactile_processing.corner_model import CornerPrior, refine_by_model, work_space
from cmp_tactile_processing.prepared_image import PreparedImage
from cmp_tactile_processing.quadratic_saddle import find_saddles, gradient_gain, quadratic_work

__all__ = ["SaddlePointFit", "SaddlePoints", "refine_saddle_points"]

ITERATIONS, OLD_CONVERGED_PX = 5, 0.03


@dataclass(frozen=True)
class SaddlePoints:
    """position (n, 2) px, NaN where the fit failed; hessian (n, 3): xx, xy, yy, grey / px^2;
    std (n,): standard deviation of the position, px per coordinate.
    """

    position: NDArray[np.float64]
    hessian: NDArray[np.float64]
    std: NDArray[np.float64]


# Half the width of the window, in checker sides and at least.  Its weights fall to zero there.
WINDOW_PER_SIDE, LEAST_WINDOW_PX, MOST_WINDOW_PX = 0.3, 2.2, 6.0
# The window has arrived when it would move by less than this, px; by less than ROUGHLY_PX where the
# corner model takes over.
CONVERGED_PX, ROUGHLY_PX = 0.02, 0.1
# Error of the saddle point and of the model without noise, px per coordinate.
BIAS_PX, MODEL_BIAS_PX = 0.006, 0.003
# Corners of checkers of at least this side are refined by the corner model.
LEAST_SIDE_OF_MODEL_PX = 8.0
MODEL_PER_SIDE, MOST_MODEL_PX = 0.5, 10.0
# Typical turn of a gridline and change of the light, in half contrasts, from checker to checker.
TURN_PER_CHECKER, LIGHT_PER_CHECKER = 0.02, 0.05
# Half contrasts by which the model may differ from a clean image, and beyond how many times this
# and the noise together a pixel counts as an outlier.
MISFIT, OUTLIER = 0.015, 2.5
# Blur that the model starts with at an image's first corner, px.
FIRST_BLUR_PX = 1.0
NONE_UNKNOWN = np.zeros((0, 0), np.bool_)


class SaddlePointFit:
    """Finds saddle points near given starts.

    side_px: side of a checker, which limits the window to the surroundings of one corner.
    Keeps buffers: one thread at a time.
    """

    def __init__(self, side_px: float) -> None:
        self._window = float(np.clip(WINDOW_PER_SIDE * side_px, LEAST_WINDOW_PX, MOST_WINDOW_PX))
        self._quadratic = quadratic_work(self._window)
        self._by_model = side_px >= LEAST_SIDE_OF_MODEL_PX
        self._prior = CornerPrior(
            radius=min(MODEL_PER_SIDE * side_px, MOST_MODEL_PX),
            noise=0.0,
            bend=TURN_PER_CHECKER / side_px,
            light=LIGHT_PER_CHECKER / side_px,
            misfit=MISFIT,
            outlier=OUTLIER,
            bias=MODEL_BIAS_PX,
        )
        self._work = work_space(self._prior.radius)

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
        saddles = np.empty((n, 2)), np.empty((n, 3)), np.empty(n)
        arrived = ROUGHLY_PX if self._by_model else CONVERGED_PX
        error = image.noise * gradient_gain(self._window, image.smoothing_px)
        limits = (self._window, arrived, error)
        find_saddles(image.smooth, (first, reach), limits, saddles, self._quadratic)
        saddles[2][:] = np.hypot(saddles[2], BIAS_PX)
        if self._by_model:
            self._prior = self._prior._replace(noise=image.noise)
            unknown = NONE_UNKNOWN if image.replaced is None else image.replaced
            pixels = np.ascontiguousarray(image.grey), unknown
            refine_by_model(pixels, self._prior, saddles, FIRST_BLUR_PX, self._work)
        return SaddlePoints(*saddles)


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
