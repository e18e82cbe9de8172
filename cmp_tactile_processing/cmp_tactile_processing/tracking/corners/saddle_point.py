"""Sub-pixel position of checker corners: a saddle point, refined by a model of the corner."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.tracking.corners.model import CornerPrior, Saddles, refine_by_model
from cmp_tactile_processing.tracking.corners.pixel_table import work_space

# Half the width of the window, in checker sides and at least.  Its weights fall to zero there.
WINDOW_PER_SIDE, LEAST_WINDOW_PX, MOST_WINDOW_PX = 0.3, 2.2, 6.0
# The same of the window that looks for corners which the start is far from.
WIDE_PER_SIDE, MOST_WIDE_PX = 0.7, 30.0
# The window has arrived when it would move by less than this, px.  Of checkers that are too small
# for the corner model (45 to 60 corners along a side; clean, blurred and noisy), errors are 6 %
# larger at a fifth of this, and the same at twice it.
CONVERGED_PX = 0.1
# Error of the saddle point and of the model without noise, px per coordinate.
BIAS_PX, MODEL_BIAS_PX = 0.006, 0.003
# Corners of checkers of at least this side are refined by the corner model.
LEAST_SIDE_OF_MODEL_PX = 8.0
MODEL_PER_SIDE, MOST_MODEL_PX = 0.42, 10.0
# Typical turn of a gridline from checker to checker, beside what its neighbours say of it, and
# typical change of the light, in half contrasts.
TURN_PER_CHECKER, LIGHT_PER_CHECKER = 0.012, 0.05
# Half contrasts by which the model may differ from a clean image, and beyond how many times this
# and the noise together a pixel counts as an outlier.
MISFIT, OUTLIER = 0.015, 2.5
# Blur that the model starts with at an image's first corner, px.
FIRST_BLUR_PX = 1.0
# Where the model's corner lies farther from the saddle point, in px and in standard deviations of
# the saddle point, the print is flawed there.
APART_PX, APART_STD = 0.1, 4.0
NONE_UNKNOWN = np.zeros((0, 0), np.bool_)

MAX_WINDOW_MOVES = 12
# The first window is wider than the others by this factor, and so is one after a move of more than
# this share of the window.
FIRST_WINDOW_RATIO = 1.6
MAX_NARROW_MOVE_SHARE = 0.35
# Longest move at once, in window sizes: a flat quadratic's stationary point may be anywhere.
LONGEST_MOVE = 0.5
# A start is a good one where the last window moves no farther from it, in window sizes.
CLOSE = 0.12
QuadraticWork = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]


@dataclass(frozen=True)
class SaddlePoints:
    """position (n, 2) px, NaN where the fit failed; hessian (n, 3): xx, xy, yy, grey / px^2;
    std (n,): standard deviation of the position, px per coordinate; modelled (n,): the model of a
    corner was fitted; pull (n, 2, 4) of both edges, 0 elsewhere: direction (x, y), and by how much
    the position moves (x, y) for each 1/px that the edge should bend more than not at all.
    """

    position: NDArray[np.float64]
    hessian: NDArray[np.float64]
    std: NDArray[np.float64]
    modelled: NDArray[np.bool_]
    pull: NDArray[np.float64]


class SaddlePointFit:
    """Finds corners near given starts.

    side_px: side of a checker, which limits the windows to the surroundings of one corner.
    Keeps buffers: one thread at a time.
    """

    def __init__(self, side_px: float) -> None:
        self._window = float(np.clip(WINDOW_PER_SIDE * side_px, LEAST_WINDOW_PX, MOST_WINDOW_PX))
        self._wide = max(min(WIDE_PER_SIDE * side_px, MOST_WIDE_PX), self._window)
        self._quadratic = quadratic_work(self._wide)
        self._by_model = side_px >= LEAST_SIDE_OF_MODEL_PX
        self._prior = CornerPrior(
            side=side_px,
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
        """Corners near `start` (n, 2) px; reach_px () or (n,): how far each may lie from its start.

        First the saddle point of the smoothed image: a quadratic is fitted by weighted least
        squares in a window, which moves to the quadratic's stationary point until it stands still.
        The weights move by fractions of a pixel and fall to zero at the window's border: a window
        that stayed on whole pixels would bias the point towards them.  Then, but for the smallest
        checkers, the model of two blurred edges is fitted to the image that is not smoothed.

        Rows are NaN where there is no saddle, where the search leaves the image, goes farther than
        `reach_px` from the start or does not converge.
        """
        n = len(start)
        # Copies: a read-only or strided array would have the kernels compiled again for its type.
        first, reach = np.array(start, dtype=np.float64, order="C"), np.empty(n)
        reach[:] = reach_px
        saddles = np.empty((n, 2)), np.empty((n, 3)), np.empty(n)
        of_model = np.zeros(n, dtype=np.bool_), np.zeros((n, 2, 4))
        error = image.noise * gradient_gain(self._window, image.smoothing_px)
        limits = (self._wide, self._window, CONVERGED_PX, error)
        find_saddles(image.smooth, (first, reach), limits, saddles, self._quadratic)
        saddles[2][:] = np.hypot(saddles[2], BIAS_PX)
        if self._by_model:
            self._prior = self._prior._replace(noise=image.noise)
            unknown = NONE_UNKNOWN if image.replaced is None else image.replaced
            pixels = np.ascontiguousarray(image.grey), unknown
            refined = saddles[0].copy(), saddles[1], saddles[2].copy(), *of_model
            refine_by_model(pixels, self._prior, refined, FIRST_BLUR_PX, self._work)
            # Salt and pepper, which the model knows about, is not a flaw of the print.
            if image.replaced is not None:
                return SaddlePoints(*refined)
            _take_where_alike(refined, saddles)
        return SaddlePoints(*saddles, *of_model)


@kernel
def _take_where_alike(
    refined: Saddles,
    saddles: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
) -> None:
    """Replace saddle points by the model's corners where noise alone sets the two apart.

    Ink that is not as the model has it may make it leave out other pixels in the next frame; the
    saddle point is then off by more, but by the same.
    """
    position, _, std = saddles
    by_model, _, std_by_model, modelled, pull = refined
    for n in range(len(position)):
        x, y = by_model[n, 0], by_model[n, 1]
        apart = np.hypot(x - position[n, 0], y - position[n, 1])
        if apart > max(APART_PX, APART_STD * std[n]):
            # What the flaw may pull it by.
            std[n] = np.hypot(std[n], apart)
            modelled[n], pull[n] = False, 0.0
        else:
            position[n, 0], position[n, 1], std[n] = x, y, std_by_model[n]


# Saddle points of a smooth image, by quadratics fitted in windows that move by sub-pixels.


def quadratic_work(widest_px: float) -> QuadraticWork:
    """Weights along x and y, (3, m) each, and the window folded along y (3, m): of one thread."""
    across = 2 * int(np.ceil(widest_px)) + 1
    x, y, folded = np.zeros((3, 3, across), np.float32)
    return x, y, folded


@lru_cache(maxsize=64)
def gradient_gain(window_px: float, smoothing_px: float) -> float:
    """Standard deviation of a component of the fitted gradient per that of the image's noise.

    Smoothing has correlated the noise: it is propagated through both filters together.
    """
    reach, blur = int(np.ceil(window_px)), int(np.ceil(4 * smoothing_px))
    t = np.arange(-reach, reach + 1.0)
    weight = np.maximum(1 - (t / window_px) ** 2, 0) ** 2
    gaussian = np.exp(-0.5 * (np.arange(-blur, blur + 1) / max(smoothing_px, 1e-3)) ** 2)
    along = np.convolve(weight * t / (weight * t * t).sum(), gaussian / gaussian.sum())
    across = np.convolve(weight / weight.sum(), gaussian / gaussian.sum())
    return float(np.linalg.norm(along) * np.linalg.norm(across))


@kernel_part(fastmath=True)
def _axis(at: float, window: float, weights: NDArray[np.float32]) -> tuple[int, int, float, float]:
    """Weights (3, m) that fit 1, t - mu and t^2 - alpha t - beta to the pixels about `at`.

    Returns the first pixel, how many, mu, alpha.  The three polynomials are orthogonal under the
    window's weight (1 - (t / window)^2)^2, so that their products in two directions are, too.
    """
    first = int(np.floor(at - window)) + 1
    count = int(np.ceil(at + window)) - first
    offset, narrow = np.float32(first - at), np.float32(1 / (window * window))
    m0 = m1 = m2 = m3 = m4 = np.float32(0)
    for k in range(count):
        t = np.float32(k) + offset
        t2 = t * t
        w = (np.float32(1) - t2 * narrow) * (np.float32(1) - t2 * narrow)
        weights[0, k] = w
        m0 += w
        m1 += w * t
        m2 += w * t2
        m3 += w * t2 * t
        m4 += w * t2 * t2
    mu = m1 / m0
    per_norm1 = 1 / (m2 - mu * m1)
    alpha = (m3 - mu * m2) * per_norm1
    beta = m2 / m0 - alpha * mu
    per_norm2 = 1 / (m4 - alpha * m3 - beta * m2)
    per_m0 = 1 / m0
    for k in range(count):
        t = np.float32(k) + offset
        w = weights[0, k]
        weights[0, k] = w * per_m0
        weights[1, k] = w * (t - mu) * per_norm1
        weights[2, k] = w * (t * t - alpha * t - beta) * per_norm2
    return first, count, float(mu), float(alpha)


@kernel_part(fastmath=True)
def _fold(
    image: NDArray[np.float32],
    place: tuple[int, int, int, int],
    in_y: NDArray[np.float32],
    folded: NDArray[np.float32],
) -> None:
    """Sums along y of the window's pixels times the weights; place: left, top, columns, rows."""
    left, top, columns, rows = place
    for j in range(columns):
        folded[0, j] = folded[1, j] = folded[2, j] = np.float32(0)
    for i in range(rows):
        w0, w1, w2 = in_y[0, i], in_y[1, i], in_y[2, i]
        row = image[top + i]
        for j in range(columns):
            value = row[left + j]
            folded[0, j] += w0 * value
            folded[1, j] += w1 * value
            folded[2, j] += w2 * value


@kernel_part(fastmath=True)
def _sums(
    in_x: NDArray[np.float32], folded: NDArray[np.float32], columns: int
) -> tuple[float, float, float, float, float]:
    """Coefficients of the polynomials x, y, x^2, xy, y^2."""
    c10 = c01 = c20 = c11 = c02 = np.float32(0)
    for j in range(columns):
        f0, f1 = folded[0, j], folded[1, j]
        c10 += in_x[1, j] * f0
        c20 += in_x[2, j] * f0
        c01 += in_x[0, j] * f1
        c11 += in_x[1, j] * f1
        c02 += in_x[0, j] * folded[2, j]
    return float(c10), float(c01), float(c20), float(c11), float(c02)


@kernel
def _quadratic(
    image: NDArray[np.float32], x: float, y: float, window: float, work: QuadraticWork
) -> tuple[float, float, float, float, float]:
    """Gradient (x, y) and Hessian (xx, xy, yy) at a place, of the quadratic fitted around it."""
    in_x, in_y, folded = work
    left, columns, mu_x, alpha_x = _axis(x, window, in_x)
    top, rows, mu_y, alpha_y = _axis(y, window, in_y)
    _fold(image, (left, top, columns, rows), in_y, folded)
    c10, c01, c20, c11, c02 = _sums(in_x, folded, columns)
    slope_x = c10 - alpha_x * c20 - mu_y * c11
    slope_y = c01 - alpha_y * c02 - mu_x * c11
    return slope_x, slope_y, 2 * c20, c11, 2 * c02


@kernel_part
def _room(image: NDArray[np.float32], x: float, y: float) -> float:
    """Widest window about a place that the image holds; negative or NaN outside."""
    height, width = image.shape
    return float(min(x, y, width - 1 - x, height - 1 - y))


@kernel_part
def _search(
    image: NDArray[np.float32],
    start: tuple[float, float, float],
    windows: tuple[float, float],
    arrived: float,
    work: QuadraticWork,
) -> tuple[float, float, float, float, float]:
    """Saddle point (x, y) and Hessian (xx, xy, yy) near a start (x, y, reach); NaN without one.

    windows: the first, which later ones after a long move are like, and the last.
    """
    none = (np.nan, np.nan, np.nan, np.nan, np.nan)
    first_x, first_y, reach = start
    wide, window = windows
    x, y = first_x, first_y
    move = np.inf if wide > window else 0.0
    for _ in range(MAX_WINDOW_MOVES):
        near = move < MAX_NARROW_MOVE_SHARE * window
        room = _room(image, x, y)
        if not (room >= window and np.hypot(x - first_x, y - first_y) <= reach):
            return none
        size = window if near else min(wide, room)
        gx, gy, hxx, hxy, hyy = _quadratic(image, x, y, size, work)
        determinant = hxx * hyy - hxy * hxy
        if not determinant < 0:
            return none
        dx, dy = (hxy * gy - hyy * gx) / determinant, (hxy * gx - hxx * gy) / determinant
        move = np.hypot(dx, dy)
        part = min(1.0, LONGEST_MOVE * size / max(move, 1e-9))
        x, y = x + part * dx, y + part * dy
        if near and move < arrived:
            if np.hypot(x - first_x, y - first_y) <= reach:
                return x, y, hxx, hxy, hyy
            return none
    return none


@kernel
def find_saddles(
    image: NDArray[np.float32],
    starts: tuple[NDArray[np.float64], NDArray[np.float64]],
    limits: tuple[float, float, float, float],
    saddles: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    work: QuadraticWork,
) -> None:
    """Saddle points near the starts into position (n, 2), hessian (n, 3) and std (n,), or NaN.

    starts: (n, 2) and how far the saddle point may lie from each, px; limits: half the width of
    the widest window, for what narrower ones do not find, and of the last; a shorter move than
    which is the last, px; standard deviation of a component of the gradient, grey levels per px.
    """
    start, reach = starts
    wide, window, arrived, gradient_error = limits
    position, hessian, std = saddles
    for n in range(len(start)):
        place = (start[n, 0], start[n, 1], reach[n])
        # Most starts are good ones, which the last window finds by itself.
        close = (start[n, 0], start[n, 1], min(reach[n], CLOSE * window))
        x, y, hxx, hxy, hyy = _search(image, close, (window, window), arrived, work)
        if np.isnan(x):
            usual = min(FIRST_WINDOW_RATIO * window, wide)
            x, y, hxx, hxy, hyy = _search(image, place, (usual, window), arrived, work)
        if np.isnan(x):
            x, y, hxx, hxy, hyy = _search(image, place, (wide, window), arrived, work)
        position[n, 0], position[n, 1] = x, y
        hessian[n, 0], hessian[n, 1], hessian[n, 2] = hxx, hxy, hyy
        gain = np.sqrt((hxx * hxx + hyy * hyy + 2 * hxy * hxy) / 2) / (hxy * hxy - hxx * hyy)
        std[n] = gradient_error * gain
