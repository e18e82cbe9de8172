"""Noise and contrast of an image of checkers, from a lattice of its pixels."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["contrast_of", "noise_of"]

# Pixels between those that are looked at, so that an image of any size costs about the same.
SAMPLES_PER_SIDE = 96
# The high-pass is looked at where the image around it is flattest: this share of the lattice.
FLATTEST_SHARE = 0.4
# Median of |x| of a normal distribution of standard deviation 1; sum of the squared weights of
# the fourth difference (1, -4, 6, -4, 1), which is the gain of the two-way difference.
MEDIAN_OF_NORMAL, HIGH_PASS_GAIN = 0.6745, 70.0
# |high-pass| is counted in bins up to this, which is noise of 40 grey levels.
HIGH_PASS_BINS = 4096
# Half the side of what the noise is measured on, px.
REACH = 3
# Quantisation alone; nothing is known better than that.
QUANTISATION = 12**-0.5


def noise_of(grey: NDArray[np.uint8]) -> float:
    """Standard deviation of the noise of a uint8 image without salt and pepper, grey levels.

    The median of the fourth difference in both directions, over the pixels around which the
    image is flattest by pixels that the difference does not use: edges have little part in it,
    and choosing does not make the noise seem smaller.
    """
    height, width = grey.shape
    if min(height, width) <= 4 * REACH:
        return QUANTISATION
    step = max(min(height, width) // SAMPLES_PER_SIDE, 1)
    flatness, high_pass = np.zeros(512, np.int64), np.zeros(HIGH_PASS_BINS, np.int64)
    return float(max(_noise(grey, step, flatness, high_pass), QUANTISATION))


def contrast_of(grey: NDArray[np.uint8]) -> float:
    """Grey levels between the 5th and the 95th percentile."""
    step = max(min(grey.shape) // SAMPLES_PER_SIDE, 1)
    return float(_contrast(grey, step, np.zeros(256, np.int64)))


@njit(cache=True, nogil=True)
def _quantile(histogram: NDArray[np.int64], share: float) -> float:
    """Quantile of counted integers, linear within a bin that reaches half to either side."""
    total = 0
    for count in histogram:
        total += count
    wanted, below = share * total, 0
    for k in range(len(histogram)):
        if histogram[k] > 0 and below + histogram[k] >= wanted:
            return float(k - 0.5 + (wanted - below) / histogram[k])
        below += histogram[k]
    return float(len(histogram) - 1)


@njit(cache=True, nogil=True)
def _contrast(grey: NDArray[np.uint8], step: int, histogram: NDArray[np.int64]) -> float:
    for y in range(step // 2, grey.shape[0], step):
        for x in range(step // 2, grey.shape[1], step):
            histogram[grey[y, x]] += 1
    return _quantile(histogram, 0.95) - _quantile(histogram, 0.05)


@njit(cache=True, nogil=True)
def _slope(grey: NDArray[np.uint8], y: int, x: int) -> int:
    """Sum of the differences across the pixel, from pixels outside the high-pass's window."""
    across = abs(np.int64(grey[y, x + REACH]) - np.int64(grey[y, x - REACH]))
    along = abs(np.int64(grey[y + REACH, x]) - np.int64(grey[y - REACH, x]))
    return int(across + along)


@njit(cache=True, nogil=True)
def _noise(
    grey: NDArray[np.uint8],
    step: int,
    flatness: NDArray[np.int64],
    high_pass: NDArray[np.int64],
) -> float:
    height, width = grey.shape
    for y in range(REACH, height - REACH, step):
        for x in range(REACH, width - REACH, step):
            flatness[_slope(grey, y, x)] += 1
    limit = _quantile(flatness, FLATTEST_SHARE) + 0.5
    for y in range(REACH, height - REACH, step):
        for x in range(REACH, width - REACH, step):
            if _slope(grey, y, x) > limit:
                continue
            total = 0
            for k, weight in ((-2, 1), (-1, -4), (0, 6), (1, -4), (2, 1)):
                row = np.int64(grey[y + k, x - 2]) + np.int64(grey[y + k, x + 2])
                row -= 4 * (np.int64(grey[y + k, x - 1]) + np.int64(grey[y + k, x + 1]))
                total += weight * (row + 6 * np.int64(grey[y + k, x]))
            high_pass[min(abs(total), len(high_pass) - 1)] += 1
    return _quantile(high_pass, 0.5) / (MEDIAN_OF_NORMAL * HIGH_PASS_GAIN)
