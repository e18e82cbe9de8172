"""A checker corner as two blurred edges that cross, fitted to the pixels around it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.tracking.corners.pixel_table import (
    ALL,
    BEND,
    BLUR,
    ODD,
    OFFSET,
    ONE,
    P_ANGLE,
    P_BEND,
    P_BLUR,
    P_COS,
    P_HALF,
    P_LEFT,
    P_LIGHT,
    P_MEAN,
    P_SIN,
    P_SLOPE,
    P_SPREAD,
    P_USUAL,
    PRODUCT,
    RESIDUAL,
    SCRATCH,
    TURN,
    WEIGHT,
    WorkSpace,
    X,
    fill_up,
    gather,
    product,
    set_block,
    set_by_blur,
    set_by_edge,
    set_by_noise,
    set_light,
    set_profile,
    set_weighted,
    shift,
    weigh,
)

# The first step starts from directions and a blur that are not the corner's own; outliers are
# found from their error at so many times the final limit.
FIRST_LIMIT = 3.0
MOST_STEPS = 8
# A step shorter than this is the last one.
CONVERGED_PX = 0.004
# So is a first step below this with a change of log(blur) below MAX_FIRST_BLUR_CHANGE, if it leaves
# at most MAX_CLEAN_RATIO times noise and misfit and no outliers: the rest decreases with the square
# of the step.
FIRST_CONVERGED_PX = 0.03
MAX_FIRST_BLUR_CHANGE = 0.1
MAX_CLEAN_RATIO = 1.3
# A corner that the model takes farther from the saddle point is none, in window radii.
FARTHEST = 0.15
# Where the model does not fit, dirt, a flaw or a sharp bend pulls the saddle point: by so much, in
# sides (0.013 to 0.022 among 700 such corners of six random sensors).
UNMODELLED = 0.02
# Prior of a corner's blur: about the mean of so many corners before it, with this standard
# deviation of log(blur).  It is used once so many are known.
PRIOR_CORNERS = 5
BLUR_PRIOR_STD = 0.25
# The same of the slope of the light, with this share of its usual standard deviation: a blurred
# edge alone could as well be a slope.
SLOPE_PRIOR_STD_SHARE = 0.4
MOST_TURN, LEAST_BLUR_PX = 0.2, 0.3
# What the next gridlines, blurred into the window, move a corner by, in checker sides: times the
# Gaussian of their distance from the window (measured on frames with 4 to 7 px of blur).
FROM_NEXT_EDGES = 0.03

Array = NDArray[np.float64]
Saddles = tuple[Array, Array, Array, NDArray[np.bool_], Array]


class CornerPrior(NamedTuple):
    """What is known of an image's corners before one is measured.

    side: of a checker, px; radius: of the window, px; noise: standard deviation, grey levels; bend:
    standard deviation of an edge's curvature, 1/px; light: of the slope of the light, half
    contrasts per px; misfit: half contrasts by which model and image may differ; outlier: so many
    of noise and misfit count in full; bias: error that remains without noise, px per coordinate.
    """

    side: float
    radius: float
    noise: float
    bend: float
    light: float
    misfit: float
    outlier: float
    bias: float


@kernel_part
def _set_sines(p: Array) -> None:
    for line in range(2):
        p[P_COS + line], p[P_SIN + line] = np.cos(p[P_ANGLE + line]), np.sin(p[P_ANGLE + line])


@kernel_part
def _set_directions(hessian: Array, p: Array) -> None:
    """Directions along which a saddle is level, which are about those of the edges."""
    mean, half = (hessian[0] + hessian[2]) / 2, (hessian[0] - hessian[2]) / 2
    axis = np.arctan2(hessian[1], half)
    opening = np.arccos(min(max(-mean / np.hypot(half, hessian[1]), -1.0), 1.0))
    p[P_ANGLE], p[P_ANGLE + 1] = (axis + opening) / 2, (axis - opening) / 2
    _set_sines(p)


@kernel_part
def _factor(a: Array, first: int, size: int) -> bool:
    """Factors of a block L D L^T: 1 / D on its diagonal, L below, D L^T above.

    False if it is not positive definite.  Unsigned: no index could count from the end.
    """
    positive = True
    for j in range(size):
        jj = np.uint64(first + j)
        pivot = a[jj, jj]
        for k in range(j):
            kk = np.uint64(first + k)
            pivot -= a[jj, kk] * a[kk, jj]
        positive &= pivot > 0
        a[jj, jj] = 1 / pivot
        for i in range(j + 1, size):
            ii = np.uint64(first + i)
            value = a[ii, jj]
            for k in range(j):
                kk = np.uint64(first + k)
                value -= a[ii, kk] * a[kk, jj]
            a[jj, ii] = value
            a[ii, jj] = value * a[jj, jj]
    return positive


@kernel
def _solve(a: Array, first: int, size: int, b: Array) -> float:
    """Solution in place of the right side; by how much it lowers the sum of squares."""
    gain = 0.0
    for i in range(size):
        ii = np.uint64(first + i)
        value = b[ii]
        for k in range(i):
            kk = np.uint64(first + k)
            value -= a[ii, kk] * b[kk]
        b[ii] = value
    for i in range(size):
        ii = np.uint64(first + i)
        value = b[ii]
        b[ii] = value * a[ii, ii]
        gain += value * b[ii]
    for i in range(size - 1, -1, -1):
        ii = np.uint64(first + i)
        value = b[ii]
        for k in range(i + 1, size):
            kk = np.uint64(first + k)
            value -= a[kk, ii] * b[kk]
        b[ii] = value
    return gain


@kernel_part
def _expected_residual(prior: CornerPrior, p: Array) -> float:
    """Of noise and of what the model's shape leaves, grey levels."""
    return float(prior.noise + prior.misfit * abs(p[P_HALF]))


@kernel_part
def _solve_for_step(work: WorkSpace, count: int, prior: CornerPrior, renew: bool) -> float:
    """Step of least squares with the prior, with a new normal matrix or the last one.

    Returns the weighted mean square of the residuals that the step leaves, NaN without one.
    """
    _, pixels, normal, side, p = work
    variance = _expected_residual(prior, p) ** 2
    firm_bend = variance / prior.bend**2
    firm_light = variance / (prior.light * p[P_LEFT] * p[P_HALF]) ** 2
    firm_blur = variance / p[P_SPREAD] ** 2
    set_weighted(pixels, count, RESIDUAL)
    for i in range(ODD if renew else ALL):
        side[i] = product(pixels, count, SCRATCH, i)
    if renew:
        for first in (0, ODD):
            set_block(pixels, count, first, first, normal)
            set_block(pixels, count, first + 3, first, normal)
            set_block(pixels, count, first + 3, first + 3, normal)
        for i in range(ODD, ALL):
            side[i] = normal[RESIDUAL, i]
    squares = product(pixels, count, SCRATCH, RESIDUAL)
    weights = product(pixels, count, WEIGHT, ONE)
    for line in range(2):
        side[BEND + line] += firm_bend * p[P_BEND + line]
        side[X + line] -= firm_light * (p[P_LIGHT + line] - p[P_HALF] * p[P_SLOPE + line])
        if renew:
            normal[BEND + line, BEND + line] += firm_bend
            normal[X + line, X + line] += firm_light
    side[BLUR] -= firm_blur * np.log(p[P_BLUR] / p[P_USUAL])
    if renew:
        normal[BLUR, BLUR] += firm_blur
    if renew and not (_factor(normal, 0, ODD) and _factor(normal, ODD, ALL - ODD)):
        return np.nan
    squares -= _solve(normal, 0, ODD, side) + _solve(normal, ODD, ALL - ODD, side)
    return max(squares, 0.0) / max(weights, 1.0)


@kernel_part
def _move(p: Array, step: Array) -> tuple[float, float]:
    """Where both edges cross once each is offset by its part of the step."""
    c1, s1, c2, s2 = p[P_COS], p[P_SIN], p[P_COS + 1], p[P_SIN + 1]
    sine = c1 * s2 - s1 * c2
    return (step[1] * c1 - step[0] * c2) / sine, (step[1] * s1 - step[0] * s2) / sine


@kernel_part
def _update(p: Array, step: Array, radius: float) -> None:
    for line in range(2):
        p[P_BEND + line] -= step[BEND + line]
        p[P_LIGHT + line] += step[X + line]
        p[P_ANGLE + line] -= min(max(step[TURN + line], -MOST_TURN), MOST_TURN)
    _set_sines(p)
    p[P_MEAN] += step[ONE]
    p[P_HALF] += step[PRODUCT]
    p[P_BLUR] *= np.exp(min(max(step[BLUR], -0.5), 0.5))
    p[P_BLUR] = min(max(p[P_BLUR], LEAST_BLUR_PX), radius)


@kernel_part
def _converge(
    work: WorkSpace, count: int, prior: CornerPrior, tolerance: float
) -> tuple[float, float, float]:
    """Move the model until it fits; how far its corner went and the mean square of the residuals.

    tolerance: expected error of the start, px.  NaN where the corner does not come to rest.
    """
    _, pixels, _, step, p = work
    right = down = 0.0
    for n in range(MOST_STEPS):
        if n > 0:
            set_profile(pixels, count, 0, p)
            set_profile(pixels, count, 1, p)
        for line in range(2):
            set_by_edge(pixels, count, line, p)
        set_by_blur(pixels, count, p)
        scale = _expected_residual(prior, p)
        limit = prior.outlier * scale * (FIRST_LIMIT if n == 0 else 1.0)
        weigh(pixels, count, p, prior.radius, limit)
        variance = _solve_for_step(work, count, prior, n in (0, 2, 5))
        dx, dy = _move(p, step)
        right += dx
        down += dy
        far = np.hypot(dx, dy)
        if not (variance >= 0 and np.hypot(right, down) < FARTHEST * prior.radius):
            break
        _update(p, step, prior.radius)
        # What is left after the first step goes with its square.
        near = far < FIRST_CONVERGED_PX + tolerance and abs(step[BLUR]) < MAX_FIRST_BLUR_CHANGE
        if far < CONVERGED_PX + 0.1 * tolerance or (
            n == 0 and near and variance < (MAX_CLEAN_RATIO * scale) ** 2
        ):
            return right, down, variance
        shift(pixels, count, dx, dy)
    return np.nan, np.nan, np.nan


@kernel
def _deviation(work: WorkSpace, count: int, variance: float) -> float:
    """Standard deviation of the corner per coordinate under noise of that variance, px.

    The window's weights are not those of the noise: what each pixel's noise does is added up.
    """
    _, pixels, normal, side, p = work
    for line in range(2):
        side[:] = 0
        side[OFFSET + line] = 1
        _solve(normal, 0, ODD, side)
        set_by_noise(pixels, count, side)
        if line == 0:
            for k in range(count):
                pixels[PRODUCT, k] = pixels[SCRATCH, k]
    first = product(pixels, count, PRODUCT, PRODUCT)
    second = product(pixels, count, SCRATCH, SCRATCH)
    both = product(pixels, count, PRODUCT, SCRATCH)
    cosine = p[P_COS] * p[P_COS + 1] + p[P_SIN] * p[P_SIN + 1]
    spread = (first + second - 2 * cosine * both) / (1 - cosine * cosine)
    return float(np.sqrt(variance * spread / 2))


@kernel
def _set_pull(work: WorkSpace, prior: CornerPrior, pull: Array) -> None:
    """Of both edges: direction, and the corner's move per 1/px by which the edge should bend.

    None where the edges hardly cross, as on a flaw of the print: a bend would then move the corner
    by more than any in the window is off its edge.
    """
    _, _, normal, side, p = work
    firm_bend = (_expected_residual(prior, p) / prior.bend) ** 2
    for line in range(2):
        side[:] = 0
        side[BEND + line] = -firm_bend
        _solve(normal, 0, ODD, side)
        x, y = _move(p, side)
        if not np.hypot(x, y) < prior.radius**2:
            pull[:] = 0.0
            return
        pull[line, 0], pull[line, 1] = p[P_COS + line], p[P_SIN + line]
        pull[line, 2], pull[line, 3] = x, y


@kernel
def refine_by_model(
    image: tuple[NDArray[np.uint8], NDArray[np.bool_]],
    prior: CornerPrior,
    saddles: Saddles,
    blur: float,
    work: WorkSpace,
) -> None:
    """Replace position, standard deviation and pull of saddle points by those of the fitted model.

    image: grey levels (H, W) and which of them are unknown, (H, W) or (0, 0) where none is;
    saddles: position (n, 2), hessian (n, 3), std (n,), modelled (n,), pull (n, 2, 4).  Saddle
    points that the model does not fit stay, with a larger deviation.  blur: expected of the first
    corner, px.
    """
    position, hessian, std, modelled, pull = saddles
    disc, pixels, _, _, p = work
    for k in range(disc.shape[1]):
        disc[2, k] = disc[1, k] * image[0].shape[1] + disc[0, k]
    known = 0
    right = down = 0.0
    for n in range(len(position)):
        if not np.isfinite(position[n, 0]):
            continue
        seen = gather(image, position[n], disc, pixels)
        count = fill_up(pixels, seen, prior.radius)
        p[:] = 0
        p[P_BLUR] = p[P_USUAL] = blur
        enough = known >= PRIOR_CORNERS
        p[P_SPREAD] = BLUR_PRIOR_STD if enough else 1.0
        p[P_SLOPE], p[P_SLOPE + 1] = right, down
        p[P_LEFT] = SLOPE_PRIOR_STD_SHARE if enough else 1.0
        _set_directions(hessian[n], p)
        set_profile(pixels, count, 0, p)
        set_profile(pixels, count, 1, p)
        set_light(pixels, seen, p)
        dx, dy, variance = _converge(work, count, prior, std[n])
        if not np.isfinite(dx):
            std[n] = np.hypot(std[n], UNMODELLED * prior.side)
        else:
            position[n, 0] += dx
            position[n, 1] += dy
            modelled[n] = True
            known += 1
            share = 1 / min(known, PRIOR_CORNERS)
            blur *= (p[P_BLUR] / blur) ** share
            right += share * (p[P_LIGHT] / p[P_HALF] - right)
            down += share * (p[P_LIGHT + 1] / p[P_HALF] - down)
            # What the model's shape leaves is even about the corner and moves it little.
            variance -= (prior.misfit * p[P_HALF]) ** 2 / 2
            deviation = _deviation(work, count, max(variance, prior.noise**2))
            outside = (prior.side - prior.radius) / p[P_BLUR]
            next_edges = FROM_NEXT_EDGES * prior.side * np.exp(-0.5 * outside * outside)
            std[n] = np.hypot(deviation, prior.bias + next_edges)
            _set_pull(work, prior, pull[n])
