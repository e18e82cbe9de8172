"""A checker corner as two blurred edges that cross, fitted to the pixels around it.

The pixels are a table with one row for each quantity, in single precision: each loop of the fit
runs along rows, and is compiled to vectors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part

# Rows of the table.  First the derivatives of the grey level by the model's parameters.
# About the corner, those of the first six are odd: offsets and curvatures of both edges, slope of
# the light; those of the other five are even: turns of both edges, mean, half contrast, logarithm
# of the blur.  The two sets hardly influence one another and are solved for apart.
OFFSET, BEND, X, Y, TURN, ONE, PRODUCT, BLUR = 0, 2, 4, 5, 6, 8, 9, 10
ODD, ALL = 6, 11
# Then what is measured, which is a twelfth column to them, the profiles of both edges, room for a
# product, and the pixels' places in the window.
RESIDUAL, GREY, WEIGHT, VALUE, SLOPE, SCRATCH = 11, 12, 13, 14, 16, 18
DISC_X, DISC_Y, ROWS = 19, 20, 21
# Compiled loops take so many pixels at once; those that are left would be taken one by one.
VECTOR = 32
# State of the model: curvatures (1/px), slope of the light (1/px), angles of the edges, mean, half
# contrast, blur (px), cosines and sines of the angles.
P_BEND, P_LIGHT, P_ANGLE, P_MEAN, P_HALF, P_BLUR, P_COS, P_SIN = 0, 2, 4, 6, 7, 8, 9, 11
# What the corners before let expect: blur and its standard deviation as a logarithm, slope of the
# light in half contrasts and the share of its standard deviation that is left.
P_USUAL, P_SPREAD, P_SLOPE, P_LEFT, STATE = 13, 14, 15, 17, 18
# An edge's profile is the integral of (1 - z^2)^3, z = distance / (3 blur): close to a Gaussian's
# integral, without its tails, and made of products alone, which compile to vectors.
PROFILE_REACH, PROFILE_SCALE = 3.0, 35 / 16
WorkSpace = tuple[
    NDArray[np.int64],
    NDArray[np.float32],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
]
# The first step starts from directions and a blur that are not the corner's own; outliers are
# found from their error at so many times the final limit.
FIRST_LIMIT = 3.0
MOST_STEPS = 8
# A step this short is the last.  So is a first step below FIRST_ARRIVED_PX that leaves no more than
# CLEAN times noise and misfit, without outliers then, as the rest goes with the step's square.
ARRIVED_PX, FIRST_ARRIVED_PX, SAME_BLUR, CLEAN = 0.004, 0.03, 0.1, 1.3
# A corner that the model takes farther from the saddle point is none, in window radii.
FARTHEST = 0.15
# The blur of a corner's edges is expected to be that of the corners before it, of which the last
# one counts by LATEST_SHARE, within a standard deviation of its logarithm; once some are known.
# So is the slope of the light: a blurred edge alone could as well be one.
BLUR_SPREAD, SLOPE_LEFT, LATEST_SHARE, ENOUGH_CORNERS = 0.25, 0.4, 0.2, 4
MOST_TURN, LEAST_BLUR_PX = 0.2, 0.3
# What the next gridlines, blurred into the window, move a corner by, in checker sides: times the
# Gaussian of their distance from the window (measured on frames with 4 to 7 px of blur).
FROM_NEXT_EDGES = 0.03
Array = NDArray[np.float64]
Saddles = tuple[Array, Array, Array, NDArray[np.bool_], Array]


def work_space(radius_px: float) -> WorkSpace:
    """Disc of pixels (x, y and place in the image, m), their table (ROWS, m or more), normal
    matrix, its right side, state of the model.

    They belong to one thread.
    """
    reach = int(radius_px)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = np.stack([x, y, y])[:, x**2 + y**2 <= radius_px**2].astype(np.int64)
    total = disc.shape[1]
    pixels = np.ones((ROWS, -(-total // VECTOR) * VECTOR), np.float32)
    pixels[DISC_X, :total], pixels[DISC_Y, :total] = disc[0], disc[1]
    return disc, pixels, np.zeros((ALL + 1, ALL + 1)), np.zeros(ALL), np.zeros(STATE)


@kernel
def gather(
    image: tuple[NDArray[np.uint8], NDArray[np.bool_]],
    position: NDArray[np.float64],
    disc: NDArray[np.int64],
    pixels: NDArray[np.float32],
) -> int:
    """Known pixels of the image around a position into the table, and their number."""
    grey, unknown = image
    height, width = grey.shape
    flat = grey.reshape(-1)
    x, y = int(np.rint(position[0])), int(np.rint(position[1]))
    right, down = np.float32(position[0] - x), np.float32(position[1] - y)
    total = disc.shape[1]
    reach = disc[1, total - 1]
    inside = x >= reach and y >= reach and x + reach < width and y + reach < height
    if inside and unknown.size == 0:
        offset, levels = disc[2], pixels[GREY]
        for k in range(total):
            levels[k] = np.float32(flat[y * width + x + offset[k]])
        for k in range(total):
            pixels[X, k] = pixels[DISC_X, k] - right
            pixels[Y, k] = pixels[DISC_Y, k] - down
        return int(total)
    count = 0
    for k in range(total):
        u, v = x + disc[0, k], y + disc[1, k]
        inside = 0 <= u < width and 0 <= v < height
        if inside and (unknown.size == 0 or not unknown[v, u]):
            pixels[GREY, count] = np.float32(grey[v, u])
            pixels[X, count] = pixels[DISC_X, k] - right
            pixels[Y, count] = pixels[DISC_Y, k] - down
            count += 1
    return count


@kernel_part
def fill_up(pixels: NDArray[np.float32], count: int, radius: float) -> int:
    """Fill up to a multiple of VECTOR; the number of all pixels.

    Those that are added lie so far outside of the window that they have no weight, wherever the
    corner moves to.
    """
    full = -(-count // VECTOR) * VECTOR
    for k in range(count, full):
        pixels[X, k] = pixels[Y, k] = np.float32(radius)
        pixels[GREY, k] = np.float32(0)
    return full


@kernel_part(fastmath=True)
def shift(pixels: NDArray[np.float32], count: int, dx: float, dy: float) -> None:
    """Pixels as seen from a corner that has moved by (dx, dy)."""
    right, down = np.float32(dx), np.float32(dy)
    for k in range(count):
        pixels[X, k] -= right
        pixels[Y, k] -= down


@kernel(fastmath=True)
def set_profile(pixels: NDArray[np.float32], count: int, line: int, p: NDArray[np.float64]) -> None:
    """Value and slope of an edge's profile at the pixels."""
    c, s = np.float32(p[P_COS + line]), np.float32(p[P_SIN + line])
    bend = np.float32(p[P_BEND + line])
    per_reach, scale = np.float32(1 / (PROFILE_REACH * p[P_BLUR])), np.float32(PROFILE_SCALE)
    one, c5, c7 = np.float32(1), np.float32(0.6), np.float32(1 / 7)
    for k in range(count):
        x, y = pixels[X, k], pixels[Y, k]
        u = x * c + y * s
        z = min(max((y * c - x * s - bend * u * u) * per_reach, -one), one)
        q = z * z
        pixels[VALUE + line, k] = scale * z * (one - q * (one - q * (c5 - q * c7)))
        q = one - q
        pixels[SLOPE + line, k] = scale * per_reach * q * q * q
    if line == 1:
        for k in range(count):
            pixels[PRODUCT, k] = pixels[VALUE, k] * pixels[VALUE + 1, k]


@kernel_part(fastmath=True)
def set_by_edge(pixels: NDArray[np.float32], count: int, line: int, p: NDArray[np.float64]) -> None:
    """Derivatives by an edge's offset, curvature and turn."""
    c, s = np.float32(p[P_COS + line]), np.float32(p[P_SIN + line])
    half = np.float32(p[P_HALF])
    for k in range(count):
        pixels[OFFSET + line, k] = half * pixels[SLOPE + line, k] * pixels[VALUE + 1 - line, k]
    for k in range(count):
        u = pixels[X, k] * c + pixels[Y, k] * s
        by_turn = u * pixels[OFFSET + line, k]
        pixels[TURN + line, k] = by_turn
        pixels[BEND + line, k] = u * by_turn


@kernel_part(fastmath=True)
def set_by_blur(pixels: NDArray[np.float32], count: int, p: NDArray[np.float64]) -> None:
    """Derivatives by the logarithm of the blur, from those by the offsets."""
    c1, s1 = np.float32(p[P_COS]), np.float32(p[P_SIN])
    c2, s2 = np.float32(p[P_COS + 1]), np.float32(p[P_SIN + 1])
    for k in range(count):
        x, y = pixels[X, k], pixels[Y, k]
        by_first = (x * s1 - y * c1) * pixels[OFFSET, k]
        pixels[BLUR, k] = by_first + (x * s2 - y * c2) * pixels[OFFSET + 1, k]


@kernel_part(fastmath=True)
def weigh(
    pixels: NDArray[np.float32], count: int, p: NDArray[np.float64], radius: float, most: float
) -> None:
    """Residuals, and weights that fall to zero at the window's border and less for outliers."""
    gx, gy = np.float32(p[P_LIGHT]), np.float32(p[P_LIGHT + 1])
    mean, half = np.float32(p[P_MEAN]), np.float32(p[P_HALF])
    for k in range(count):
        light = mean + gx * pixels[X, k] + gy * pixels[Y, k]
        pixels[RESIDUAL, k] = pixels[GREY, k] - light - half * pixels[PRODUCT, k]
    per_radius2, limit = np.float32(1 / (radius * radius)), np.float32(most)
    for k in range(count):
        x, y = pixels[X, k], pixels[Y, k]
        inner = max(np.float32(1) - (x * x + y * y) * per_radius2, np.float32(0))
        pixels[WEIGHT, k] = inner * limit / max(abs(pixels[RESIDUAL, k]), limit)


@kernel(fastmath=True)
def set_weighted(pixels: NDArray[np.float32], count: int, row: int) -> None:
    """A row times the weights into the scratch row."""
    for k in range(count):
        pixels[SCRATCH, k] = pixels[WEIGHT, k] * pixels[row, k]


@kernel_part(fastmath=True)
def product(pixels: NDArray[np.float32], count: int, i: int, j: int) -> float:
    """Sum of the products of two rows."""
    total = np.float32(0)
    for k in range(count):
        total += pixels[i, k] * pixels[j, k]
    return float(total)


@kernel_part(fastmath=True)
def set_block(
    pixels: NDArray[np.float32], count: int, i: int, j: int, normal: NDArray[np.float64]
) -> None:
    """Weighted products of three rows with three rows, which one reading of the table serves."""
    s00 = s01 = s02 = s10 = s11 = s12 = s20 = s21 = s22 = np.float32(0)
    for k in range(count):
        w = pixels[WEIGHT, k]
        a, b, c = pixels[j, k], pixels[j + 1, k], pixels[j + 2, k]
        d, e, f = w * pixels[i, k], w * pixels[i + 1, k], w * pixels[i + 2, k]
        s00 += d * a
        s01 += d * b
        s02 += d * c
        s10 += e * a
        s11 += e * b
        s12 += e * c
        s20 += f * a
        s21 += f * b
        s22 += f * c
    normal[i, j], normal[i, j + 1], normal[i, j + 2] = s00, s01, s02
    normal[i + 1, j], normal[i + 1, j + 1], normal[i + 1, j + 2] = s10, s11, s12
    normal[i + 2, j], normal[i + 2, j + 1], normal[i + 2, j + 2] = s20, s21, s22


@kernel_part(fastmath=True)
def set_light(pixels: NDArray[np.float32], count: int, p: NDArray[np.float64]) -> None:
    """Mean and half contrast by regression on the product of both profiles."""
    f1 = f2 = g1 = gf = np.float32(0)
    for k in range(count):
        f, g = pixels[PRODUCT, k], pixels[GREY, k]
        f1 += f
        f2 += f * f
        g1 += g
        gf += g * f
    spread = f2 - f1 * f1 / count
    p[P_HALF] = (gf - f1 * g1 / count) / spread
    p[P_MEAN] = (g1 - p[P_HALF] * f1) / count


@kernel(fastmath=True)
def set_by_noise(pixels: NDArray[np.float32], count: int, side: NDArray[np.float64]) -> None:
    """What each pixel's noise does to an unknown, of which `side` is its row of the inverse normal
    matrix, into the scratch row.
    """
    s0, s1, s2 = np.float32(side[0]), np.float32(side[1]), np.float32(side[2])
    s3, s4, s5 = np.float32(side[3]), np.float32(side[4]), np.float32(side[5])
    for k in range(count):
        odd = s0 * pixels[0, k] + s1 * pixels[1, k] + s2 * pixels[2, k]
        odd += s3 * pixels[3, k] + s4 * pixels[4, k] + s5 * pixels[5, k]
        pixels[SCRATCH, k] = pixels[WEIGHT, k] * odd


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
        near = far < FIRST_ARRIVED_PX + tolerance and abs(step[BLUR]) < SAME_BLUR
        if far < ARRIVED_PX + 0.1 * tolerance or (
            n == 0 and near and variance < (CLEAN * scale) ** 2
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
    points that the model does not fit stay as they are.  blur: expected of the first corner, px.
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
        enough = known >= ENOUGH_CORNERS
        p[P_SPREAD] = BLUR_SPREAD if enough else 1.0
        p[P_SLOPE], p[P_SLOPE + 1] = right, down
        p[P_LEFT] = SLOPE_LEFT if enough else 1.0
        _set_directions(hessian[n], p)
        set_profile(pixels, count, 0, p)
        set_profile(pixels, count, 1, p)
        set_light(pixels, seen, p)
        dx, dy, variance = _converge(work, count, prior, std[n])
        if np.isfinite(dx):
            position[n, 0] += dx
            position[n, 1] += dy
            modelled[n] = True
            known += 1
            share = max(1 / known, LATEST_SHARE)
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
