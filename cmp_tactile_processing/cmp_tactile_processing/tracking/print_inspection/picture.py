"""What an undamaged print would look like in an image, and how the image departs from it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel

Image = NDArray[np.float32]
# Standard deviations of the blur that are tried, px; neighbours differ so little that the rest is
# below what a spot must reach.
BLURS = (0.3, 0.5, 0.7, 0.9, 1.15, 1.45, 1.8, 2.25, 2.8, 3.5, 4.4)
# Blurs tried in each part of the image, in steps around that of the whole.
LOCAL_STEPS = 2
# What departs is smoothed by so much before it is judged, px.
SMOOTHING_PX = 1.0
# Light and shade over the whole image are polynomials of this degree in x and y.
LIGHT_DEGREE = 3
# About so many pixels determine the light over the whole image.
LIGHT_SAMPLES = 4000
ROUNDS = 2
LEAST_PIXELS = 200
# What departs by more than this share of half the contrast does not count for light and blur.
OUTLIER = 0.5
# Half the contrast is at least this share of its median, and so many grey levels.
LEAST_CONTRAST, LEAST_GREY = 0.15, 2.0
# A knot about every so many checkers, and at most so many spans: the print at rest bends little,
# and the fit must average over enough corners to leave out a damaged one.
CHECKERS_PER_KNOT, MOST_SPANS = 3, 10
ROBUST_ROUNDS = 6
# A corner that lies so many typical deviations off counts half as much.
HALF_WEIGHT = 2.5
# Keeps the weights finite where corners are exact, px.
LEAST_DEVIATION_PX = 0.01
# Penalty of the spline's coefficients' third differences, so that hidden parts do not run wild.
SMOOTHNESS = 1e-4
# A checker is taken to pieces of half its side, within which the map is bilinear.
PIECES = 2


@dataclass(frozen=True)
class Departure:
    """An image against an undamaged print; all but the blur and the noise are (H, W) images.

    expected: -1 on dark ink, +1 on light skin, blurred as the image is.
    amount: image minus expectation in the same scale, smoothed by SMOOTHING_PX.
    noise: standard deviation of `amount`'s noise.  blur: of the edges, px.
    """

    expected: Image
    amount: Image
    noise: Image
    blur: Image


def departure(
    grey: Image, noise: float, places: PrintPlaces, usable: NDArray[np.bool_], side_px: float
) -> Departure | None:
    """How an image (H, W) departs from what the print should look like; None without contrast.

    noise: standard deviation of the image's noise, grey levels.  usable (H, W): pixels that show
    the print and are not too close to its rim.
    """
    if np.count_nonzero(usable) < LEAST_PIXELS:
        return None
    trusted, samples = usable, _Samples.from_trusted(usable)
    pictures = [_blurred(places.checker, sigma) for sigma in BLURS]
    best = int(np.argmin([samples.fit(grey, picture)[1] for picture in pictures]))
    for _ in range(ROUNDS):
        light = _light(grey, pictures[best], samples)
        if light is None:
            return None
        middle, half = light
        seen = np.asarray((grey - middle) / half, dtype=np.float32)
        expected, blur = _expected(seen, pictures, trusted, (best, side_px))
        rest, gain = _without_local_light(seen, expected, trusted, side_px)
        trusted = usable & (np.abs(rest) < OUTLIER)
        samples = _Samples.from_trusted(trusted)
    if float(np.mean(half[usable])) < 0:
        expected, rest = -expected, -rest
    amount = np.where(usable, _masked_blur(rest, usable), 0).astype(np.float32)
    scale = 1 / (2 * np.sqrt(np.pi) * SMOOTHING_PX)
    return Departure(expected, amount, noise * scale / np.abs(half * gain), blur)


def _blurred(image: Image, sigma: float) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.float32)


def _mean_around(image: Image, side_px: float) -> Image:
    """Mean over three checkers."""
    size = 2 * int(np.ceil(1.5 * side_px)) + 1
    return np.asarray(cv2.boxFilter(image, cv2.CV_32F, (size, size)), dtype=np.float32)


def _masked_blur(image: Image, mask: NDArray[np.bool_]) -> Image:
    weight = mask.astype(np.float32)
    total = _blurred(image * weight, SMOOTHING_PX)
    return np.asarray(total / np.maximum(_blurred(weight, SMOOTHING_PX), 0.1), dtype=np.float32)


@dataclass(frozen=True)
class _Samples:
    """Pixels (n,) that determine the light, and the polynomials (n, m) of their places."""

    y: NDArray[np.intp]
    x: NDArray[np.intp]
    terms: NDArray[np.float64]

    @classmethod
    def from_trusted(cls, trusted: NDArray[np.bool_]) -> _Samples:
        y, x = np.nonzero(trusted)
        step = max(1, len(y) // LIGHT_SAMPLES)
        y, x = y[::step], x[::step]
        axes = [np.linspace(-1, 1, count) for count in trusted.shape]
        terms = [axes[1][x] ** p * axes[0][y] ** q for p, q in _powers()]
        return cls(y, x, np.stack(terms, axis=1))

    def fit(self, grey: Image, expected: Image) -> tuple[NDArray[np.float64], float]:
        """Coefficients (2, m) of middle grey and half the contrast, and the mean misfit."""
        wanted = grey[self.y, self.x].astype(np.float64)
        by_print = expected[self.y, self.x].astype(np.float64)
        design = np.concatenate([self.terms, self.terms * by_print[:, None]], axis=1)
        normal = design.T @ design + 1e-6 * len(wanted) * np.eye(design.shape[1])
        found = np.linalg.solve(normal, design.T @ wanted)
        misfit = float(np.abs(wanted - design @ found).mean())
        return found.reshape(2, -1), misfit


def _powers() -> list[tuple[int, int]]:
    return [(p, q) for p in range(LIGHT_DEGREE + 1) for q in range(LIGHT_DEGREE + 1 - p)]


def _light(grey: Image, expected: Image, samples: _Samples) -> tuple[Image, Image] | None:
    """Middle grey and half the contrast over the whole image; None where there is no contrast."""
    found, _ = samples.fit(grey, expected)
    typical = float(np.median(samples.terms @ found[1]))
    if abs(typical) < LEAST_GREY:
        return None
    order = np.arange(LIGHT_DEGREE + 1)
    rows, cols = (np.linspace(-1, 1, count)[:, None] ** order for count in grey.shape)
    images = []
    for part in found:
        square = np.zeros((LIGHT_DEGREE + 1, LIGHT_DEGREE + 1))
        for (p, q), value in zip(_powers(), part, strict=True):
            square[q, p] = value
        images.append(np.asarray(rows @ square @ cols.T, dtype=np.float32))
    # Of the typical sign everywhere, and never near zero.
    sign = np.float32(np.sign(typical))
    least = np.float32(LEAST_CONTRAST * abs(typical))
    return images[0], sign * np.maximum(sign * images[1], least)


def _expected(
    seen: Image, pictures: list[Image], trusted: NDArray[np.bool_], setting: tuple[int, float]
) -> tuple[Image, Image]:
    """The print blurred as each part of the image is, and that blur; setting: blur, side px."""
    best, side_px = setting
    weight = trusted.astype(np.float32)
    least = np.full(seen.shape, np.inf, dtype=np.float32)
    expected, blur = np.zeros_like(seen), np.zeros_like(seen)
    for index in range(max(0, best - LOCAL_STEPS), min(len(BLURS), best + LOCAL_STEPS + 1)):
        picture = pictures[index]
        error = _mean_around(np.abs(seen - picture) * weight, side_px)
        better = error < least
        np.copyto(least, error, where=better)
        np.copyto(expected, picture, where=better)
        np.copyto(blur, np.float32(BLURS[index]), where=better)
    return expected, blur


def _without_local_light(
    seen: Image, expected: Image, trusted: NDArray[np.bool_], side_px: float
) -> tuple[Image, Image]:
    """What is left of an image after light and contrast of each neighbourhood, and the contrast."""
    weight = trusted.astype(np.float32)
    count = np.maximum(_mean_around(weight, side_px), 1e-3)
    mean_e = _mean_around(weight * expected, side_px) / count
    mean_s = _mean_around(weight * seen, side_px) / count
    product = _mean_around(weight * expected * seen, side_px) / count - mean_e * mean_s
    square = _mean_around(weight * expected**2, side_px) / count - mean_e**2
    # Drawn towards 1 where a neighbourhood shows little.
    gain = np.clip((product + 0.05) / (square + 0.05), 0.5, 2.0)
    rest = seen - mean_s - gain * (expected - mean_e)
    return np.asarray(rest / gain, dtype=np.float32), np.asarray(gain, dtype=np.float32)


# Where the print lies in an image: a smooth map from grid numbers to pixels, and its inverse.


@dataclass(frozen=True)
class SmoothLattice:
    """A smooth map from grid numbers (i, j) to pixels that damaged corners do not pull along.

    homography (3, 3): from (j, i, 1), what a flat print would show.  The rest is a spline; rows,
    cols: its knots and degree per direction; coefficients (m, n, 2) px; deviation_px: typical
    distance of a measured corner from the map, and uncertainty_px: what that makes of the map,
    standard deviations per coordinate.
    """

    homography: NDArray[np.float64]
    rows: tuple[NDArray[np.float64], int]
    cols: tuple[NDArray[np.float64], int]
    coefficients: NDArray[np.float64]
    deviation_px: float
    uncertainty_px: float

    def corners(self, rows: int, cols: int) -> NDArray[np.float64]:
        """Pixels (rows, cols, 2) of the corners."""
        return self.at(np.arange(rows, dtype=np.float64), np.arange(cols, dtype=np.float64))

    @classmethod
    def through(cls, corners: NDArray[np.float64]) -> SmoothLattice:
        """Robust least squares through corners (rows, cols, 2) px; NaN where not measured."""
        rows, cols = (_knots(count) for count in corners.shape[:2])
        basis_i = _basis(rows, np.arange(corners.shape[0], dtype=np.float64))
        basis_j = _basis(cols, np.arange(corners.shape[1], dtype=np.float64))
        known = np.isfinite(corners[..., 0])
        i, j = np.nonzero(known)
        size = basis_i.shape[1], basis_j.shape[1]
        design = (basis_i[i][:, :, None] * basis_j[j][:, None, :]).reshape(len(i), -1)
        homography = _homography(i, j, corners[known])
        target = corners[known] - _flat(homography, i.astype(float), j.astype(float))
        penalty = SMOOTHNESS * _roughness(*size)
        weight, solution, typical = np.ones(len(i)), np.zeros((design.shape[1], 2)), 0.0
        for _ in range(ROBUST_ROUNDS):
            weighted = design * weight[:, None]
            solution = np.linalg.solve(design.T @ weighted + penalty, weighted.T @ target)
            distance = np.linalg.norm(target - design @ solution, axis=1)
            # Median of the length of a two-dimensional normal deviate: 1.177 standard deviations.
            typical = max(float(np.median(distance)) / 1.177, LEAST_DEVIATION_PX)
            weight = 1 / (1 + (distance / (HALF_WEIGHT * typical)) ** 2) ** 2
        # Each coefficient takes its share of the corners' scatter into the map.
        share = min(0.9, design.shape[1] / len(i))
        uncertainty = typical * float(np.sqrt(share / (1 - share)))
        return cls(homography, rows, cols, solution.reshape(*size, 2), typical, uncertainty)

    def at(self, i: NDArray[np.float64], j: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (m, n, 2) at all pairs of rows i (m,) and columns j (n,), fractional or not."""
        basis_i, basis_j = _basis(self.rows, i), _basis(self.cols, j)
        by_column = np.tensordot(basis_i, self.coefficients, axes=(1, 0))
        rest = np.tensordot(by_column, basis_j, axes=(1, 1)).swapaxes(1, 2)
        return np.asarray(_flat(self.homography, i[:, None], j[None, :]) + rest)


@dataclass(frozen=True)
class PrintPlaces:
    """Each pixel's place on the print.

    number (H, W, 2): row and column, corner (i, j) at (i, j), NaN beside the print.
    checker (H, W): +1 and -1 on checkers of either colour, +1 where floor(i) + floor(j) is even;
    what lies between is the share of either colour in a pixel on an edge.
    """

    number: NDArray[np.float32]
    checker: NDArray[np.float32]


def places_in_image(
    lattice: SmoothLattice, corners: tuple[int, int], shape: tuple[int, int]
) -> PrintPlaces:
    """Places on the print, with its outermost checkers, of the pixels of an image (H, W)."""
    first = -1.0
    i, j = (first + np.arange((count + 1) * PIECES + 1) / PIECES for count in corners)
    number = np.full((*shape, 2), np.nan, dtype=np.float32)
    checker = np.zeros(shape, dtype=np.float32)
    _fill_places(lattice.at(i, j), first, number, checker)
    return PrintPlaces(number, checker)


def _homography(
    i: NDArray[np.intp], j: NDArray[np.intp], corners: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The homography closest to corners (n, 2) px; what damaged ones do to it the spline mends."""
    found, _ = cv2.findHomography(np.stack([j, i], axis=1).astype(np.float64), corners)
    if found is None:
        found = np.diag([0.0, 0.0, 1.0])
    return np.asarray(found, dtype=np.float64)


def _flat(
    homography: NDArray[np.float64], i: NDArray[np.float64], j: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Pixels (..., 2) of grid numbers by the homography."""
    (a, b, c), (d, e, f), (g, h, k) = homography
    depth = g * j + h * i + k
    return np.stack([(a * j + b * i + c) / depth, (d * j + e * i + f) / depth], axis=-1)


def _knots(count: int) -> tuple[NDArray[np.float64], int]:
    degree = int(np.clip(count - 2, 1, 3))
    spans = int(np.clip(round((count - 1) / CHECKERS_PER_KNOT), 1, MOST_SPANS))
    spans = max(1, min(spans, count - 1 - degree))
    # Evenly spaced beyond the ends, too: differences of the coefficients are those of the curve.
    numbers = np.arange(-degree, spans + degree + 1, dtype=np.float64)
    return numbers * ((count - 1) / spans), degree


def _basis(axis: tuple[NDArray[np.float64], int], x: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.interpolate import BSpline  # long to import for what is seldom done

    knots, degree = axis
    count = len(knots) - degree - 1
    spline = BSpline(knots, np.eye(count), degree, extrapolate=True)
    return np.asarray(spline(x))


def _roughness(rows: int, cols: int) -> NDArray[np.float64]:
    """Squared third differences of (rows, cols) coefficients along both directions."""
    parts = []
    for count in (rows, cols):
        difference = np.diff(np.eye(count), n=min(3, count - 1), axis=0)
        parts.append(difference.T @ difference)
    return np.kron(parts[0], np.eye(cols)) + np.kron(np.eye(rows), parts[1])


@kernel
def _fill_places(
    nodes: NDArray[np.float64],
    first: float,
    number: NDArray[np.float32],
    checker: NDArray[np.float32],
) -> None:
    """Fill number and checker from the map's pixels at nodes (m, n, 2), 1 / PIECES apart."""
    height, width = checker.shape
    for a in range(nodes.shape[0] - 1):
        for b in range(nodes.shape[1] - 1):
            x0, y0 = nodes[a, b, 0], nodes[a, b, 1]
            x1, y1 = nodes[a + 1, b, 0], nodes[a + 1, b, 1]
            x2, y2 = nodes[a, b + 1, 0], nodes[a, b + 1, 1]
            x3, y3 = nodes[a + 1, b + 1, 0], nodes[a + 1, b + 1, 1]
            left, right = min(x0, x1, x2, x3), max(x0, x1, x2, x3)
            top, bottom = min(y0, y1, y2, y3), max(y0, y1, y2, y3)
            if not (right - left < width and bottom - top < height):
                continue
            twist_x, twist_y = x3 - x1 - x2 + x0, y3 - y1 - y2 + y0
            for y in range(max(0, int(np.ceil(top))), min(height - 1, int(bottom)) + 1):
                for x in range(max(0, int(np.ceil(left))), min(width - 1, int(right)) + 1):
                    s = t = 0.5
                    det = ix = iy = jx = jy = 0.0
                    for _ in range(3):
                        ix, iy = x1 - x0 + t * twist_x, y1 - y0 + t * twist_y
                        jx, jy = x2 - x0 + s * twist_x, y2 - y0 + s * twist_y
                        rx = x - x0 - s * (x1 - x0) - t * jx
                        ry = y - y0 - s * (y1 - y0) - t * jy
                        det = ix * jy - iy * jx
                        if det == 0.0:
                            break
                        s += (rx * jy - ry * jx) / det
                        t += (ix * ry - iy * rx) / det
                    if det == 0.0 or not (-1e-6 <= s <= 1 + 1e-6 and -1e-6 <= t <= 1 + 1e-6):
                        continue
                    # Distance of the gridlines, px, of rows and of columns.
                    to_row = PIECES * abs(det) / np.sqrt(jx * jx + jy * jy)
                    to_col = PIECES * abs(det) / np.sqrt(ix * ix + iy * iy)
                    i, j = first + (a + s) / PIECES, first + (b + t) / PIECES
                    row, col = np.round(i), np.round(j)
                    number[y, x, 0], number[y, x, 1] = i, j
                    ramp = min(1.0, max(-1.0, 2 * (i - row) * to_row))
                    ramp *= min(1.0, max(-1.0, 2 * (j - col) * to_col))
                    checker[y, x] = ramp if int(row + col) % 2 == 0 else -ramp
