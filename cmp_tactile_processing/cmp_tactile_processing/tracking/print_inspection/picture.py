"""What an undamaged print would look like in an image, and how the image departs from it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.tracking.print_inspection.lattice import PrintPlaces

__all__ = ["Departure", "departure"]

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
# About so many pixels tell the light over the whole image.
LIGHT_SAMPLES = 4000
ROUNDS = 2
LEAST_PIXELS = 200
# What departs by more than this share of half the contrast does not tell light and blur.
OUTLIER = 0.5
# Half the contrast is at least this share of its median, and so many grey levels.
LEAST_CONTRAST, LEAST_GREY = 0.15, 2.0


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
    """Pixels (n,) that tell the light, and the polynomials (n, m) of their places."""

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
    # Drawn towards 1 where a neighbourhood tells little.
    gain = np.clip((product + 0.05) / (square + 0.05), 0.5, 2.0)
    rest = seen - mean_s - gain * (expected - mean_e)
    return np.asarray(rest / gain, dtype=np.float32), np.asarray(gain, dtype=np.float32)
