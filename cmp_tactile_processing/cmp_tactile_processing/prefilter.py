"""Prepares a view image for detection and measurement, as far as its noise calls for it."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from cmp_tactile_processing.noise_estimate import contrast_of, noise_of
from cmp_tactile_processing.prepared_image import PreparedImage

__all__ = ["Prefilter"]

# Smoothing before saddle points and gradients are measured, px: the lens blurs by about as much.
# More where the noise is more than a share of the contrast, less where checkers are small.
SMOOTHING_PX, MOST_SMOOTHING_PX, LEAST_SMOOTHING_PX = 1.1, 2.0, 0.5
SMOOTHING_PER_NOISE = 10.0
SMOOTHING_PER_SIDE = 0.15
# Width of the Gaussian kernel to either side, in standard deviations.
KERNEL_REACH = 3.0
# A pixel stands out that differs from the median of the 3 x 3 around it by more than this share
# of the contrast, by no fewer grey levels, and by more than noise makes likely.
STAND_OUT_CONTRAST, STAND_OUT_GREY, STAND_OUT_NOISE = 0.25, 12.0, 5.0
# An image of whose pixels more than this share stand out carries salt and pepper.
SALT_AND_PEPPER = 0.001
# Neighbours alike that make a pixel part of the pattern: a checker's tip has as many.
ALIKE = 2
# A second pass finds the rest of clusters.
PASSES = 2


class Prefilter:
    """Prepares images of one size; its buffers are overwritten by the next image.

    shape: (height, width), px; side_px: side of a checker.
    """

    def __init__(self, shape: tuple[int, int], side_px: float) -> None:
        self._side_px = side_px
        self._median = np.empty(shape, np.uint8)
        self._deviation = np.empty(shape, np.uint8)
        self._clean = np.empty(shape, np.uint8)
        self._smooth = np.empty(shape, np.float32)

    def prepare(self, grey: NDArray[np.uint8]) -> PreparedImage:
        """The image without salt and pepper, smoothed by what noise and checker side call for.

        grey: (H, W) uint8.
        """
        contrast = contrast_of(grey)
        clean = self._without_salt_and_pepper(grey, contrast)
        noise = noise_of(clean)
        sigma = smoothing_for(noise, contrast, self._side_px)
        kernel = _gaussian(sigma)
        cv2.sepFilter2D(clean, cv2.CV_32F, kernel, kernel, dst=self._smooth)
        return PreparedImage(clean, self._smooth, sigma, noise, contrast)

    def _without_salt_and_pepper(
        self, grey: NDArray[np.uint8], contrast: float
    ) -> NDArray[np.uint8]:
        limit = max(STAND_OUT_GREY, STAND_OUT_CONTRAST * contrast)
        if not _carries_impulses(grey, limit):
            np.copyto(self._clean, grey)
            return self._clean
        source = grey
        for _ in range(PASSES):
            cv2.medianBlur(source, 3, dst=self._median)
            cv2.absdiff(source, self._median, dst=self._deviation)
            np.copyto(self._clean, source)
            _replace_impulses(source, self._deviation, limit, self._clean)
            source = self._clean
        return self._clean


def smoothing_for(noise: float, contrast: float, side_px: float) -> float:
    """Standard deviation of the smoothing Gaussian, px."""
    wanted = SMOOTHING_PX + SMOOTHING_PER_NOISE * max(noise / max(contrast, 1.0) - 0.03, 0.0)
    limit = max(SMOOTHING_PER_SIDE * side_px, LEAST_SMOOTHING_PX)
    return float(min(wanted, MOST_SMOOTHING_PX, limit))


def _gaussian(sigma: float) -> NDArray[np.float32]:
    reach = max(int(np.ceil(KERNEL_REACH * sigma)), 1)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return (kernel / kernel.sum()).astype(np.float32)


def _carries_impulses(grey: NDArray[np.uint8], limit: float) -> bool:
    step = 2 if grey.size > 40_000 else 1
    return bool(_share_standing_out(grey, step, limit) > SALT_AND_PEPPER)


@njit(cache=True, nogil=True)
def _alike(grey: NDArray[np.uint8], y: int, x: int, limit: float) -> int:
    """How many of the 8 neighbours differ by less than the limit."""
    value = np.int64(grey[y, x])
    count = 0
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            count += abs(np.int64(grey[y + dy, x + dx]) - value) < limit
    return count - 1


@njit(cache=True, nogil=True)
def _share_standing_out(grey: NDArray[np.uint8], step: int, limit: float) -> float:
    """Share of a lattice of pixels that have no neighbour alike."""
    height, width = grey.shape
    count, total = 0, 0
    for y in range(1, height - 1, step):
        for x in range(1, width - 1, step):
            total += 1
            # Almost every pixel is like the one to its left or right.
            value = np.int64(grey[y, x])
            if (
                abs(value - np.int64(grey[y, x - 1])) >= limit
                and abs(value - np.int64(grey[y, x + 1])) >= limit
                and _alike(grey, y, x, limit) == 0
            ):
                count += 1
    return count / max(total, 1)


@njit(cache=True, nogil=True)
def _replace_impulses(
    source: NDArray[np.uint8],
    deviation: NDArray[np.uint8],
    limit: float,
    result: NDArray[np.uint8],
) -> None:
    """Replace what stands out from its median and has too few like it that do not stand out."""
    height, width = source.shape
    for y in range(height):
        for x in range(width):
            if deviation[y, x] <= limit:
                continue
            alike = 0
            value = np.int64(source[y, x])
            for v in range(max(y - 1, 0), min(y + 2, height)):
                for u in range(max(x - 1, 0), min(x + 2, width)):
                    near = abs(np.int64(source[v, u]) - value) < limit
                    alike += near and deviation[v, u] <= limit
            if alike < ALIKE:
                result[y, x] = _from_neighbours(source, deviation, limit, y, x)


@njit(cache=True, nogil=True)
def _from_neighbours(
    source: NDArray[np.uint8], deviation: NDArray[np.uint8], limit: float, y: int, x: int
) -> int:
    """Mean of the two opposite neighbours that differ least, which lie along an edge."""
    height, width = source.shape
    best, value = 1000, np.int64(-1)
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        if y - dy < 0 or y + dy >= height or x - 1 < 0 or x + 1 >= width:
            continue
        if deviation[y - dy, x - dx] > limit or deviation[y + dy, x + dx] > limit:
            continue
        a, b = np.int64(source[y - dy, x - dx]), np.int64(source[y + dy, x + dx])
        if abs(a - b) < best:
            best, value = abs(a - b), (a + b + 1) // 2
    if value >= 0:
        return value
    total, count = np.int64(0), 0
    for reach in (1, 2):
        for v in range(max(y - reach, 0), min(y + reach + 1, height)):
            for u in range(max(x - reach, 0), min(x + reach + 1, width)):
                if deviation[v, u] <= limit:
                    total += np.int64(source[v, u])
                    count += 1
        if count > 0:
            return total // count
    return np.int64(source[y, x])
