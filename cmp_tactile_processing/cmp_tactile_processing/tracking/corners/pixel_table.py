"""The pixels around a corner as a table, and the loops over it by which the model is fitted.

One row for each quantity, single precision: each loop runs along rows, and is compiled to vectors.
"""

from __future__ import annotations

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
