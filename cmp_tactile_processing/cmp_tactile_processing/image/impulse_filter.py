"""Salt and pepper: pixels that stand out from those around them, replaced where there are many."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["ImpulseFilter"]

# An image of whose pixels more than this share stand out from all 8 neighbours carries salt and
# pepper.
SALT_AND_PEPPER = 0.001
# A pixel stands out by more than this share of the contrast, by no fewer grey levels, by more than
# noise makes likely, and by more than the centre of a small checker does from its neighbours.
STAND_OUT_CONTRAST, STAND_OUT_GREY, STAND_OUT_NOISE, OF_CHECKER = 0.2, 12.0, 4.0, 0.75
# To tell whether there is salt and pepper it takes more: the tip of a sharp checker stands out by
# up to 0.25 of the contrast.
CERTAIN_CONTRAST = 0.3
# What noise may ask for at most, as a share of the contrast.
MOST_BY_NOISE = 0.4
# Neighbours alike that make a pixel part of the pattern: a checker's tip has as many.
ALIKE = 2
# Above this share, clusters are likely, whose rest a second pass finds.
CLUSTERS = 0.01
# Standard normal: root of the sum of squares of (1, -2, 1), and 30th percentile of its modulus.
SECOND_DIFFERENCE, LOW_QUANTILE, LOW_VALUE = 6**0.5, 0.3, 0.385


class ImpulseFilter:
    """Replaces salt and pepper in images of one size, and leaves all other pixels as they are.

    shape: (height, width), px; side_px: side of a checker.
    """

    def __init__(self, shape: tuple[int, int], side_px: float) -> None:
        self._median = np.empty(shape, np.uint8)
        self._deviation = np.empty(shape, np.uint8)
        self._step = 3 if shape[0] * shape[1] > 90_000 else 1
        peak = OF_CHECKER * (1 - np.cos(np.pi / max(side_px, 2.0)))
        self._share_of_contrast = max(STAND_OUT_CONTRAST, float(peak))

    def apply(self, grey: NDArray[np.uint8], contrast: float, clean: NDArray[np.uint8]) -> bool:
        """Copy `grey` (H, W) into `clean` without salt and pepper; whether there was any."""
        np.copyto(clean, grey)
        by_noise = min(STAND_OUT_NOISE * _rough_noise(clean, self._step), MOST_BY_NOISE * contrast)
        limit = max(STAND_OUT_GREY, self._share_of_contrast * contrast, by_noise)
        share = _share_standing_out(clean, self._step, max(limit, CERTAIN_CONTRAST * contrast))
        if share > SALT_AND_PEPPER:
            self._replace(clean, int(limit))
        if share > CLUSTERS:
            self._replace(clean, int(limit))
        return share > SALT_AND_PEPPER

    def _replace(self, clean: NDArray[np.uint8], limit: int) -> None:
        cv2.medianBlur(clean, 3, dst=self._median)
        cv2.absdiff(clean, self._median, dst=self._deviation)
        _replace_impulses(clean, self._median, self._deviation, limit)


@njit(cache=True, nogil=True)
def _rough_noise(grey: NDArray[np.uint8], step: int) -> float:
    """Standard deviation of the noise, rather too large, whatever salt and pepper there is."""
    histogram = np.zeros(1024, np.int64)
    total = 0
    for y in range(1, grey.shape[0] - 1, 4 * step):
        for x in range(1, grey.shape[1] - 1, 4 * step):
            ends = np.int64(grey[y, x - 1]) + np.int64(grey[y, x + 1])
            histogram[abs(ends - 2 * np.int64(grey[y, x]))] += 1
            total += 1
    below = 0
    for k in range(len(histogram)):
        below += histogram[k]
        if below >= LOW_QUANTILE * total:
            return (k + 0.5) / (SECOND_DIFFERENCE * LOW_VALUE)
    return 0.0


@njit(cache=True, nogil=True)
def _share_standing_out(grey: NDArray[np.uint8], step: int, limit: float) -> float:
    """Share of a lattice of pixels that have no neighbour alike.

    Counts no farther than what tells that it is more than CLUSTERS.
    """
    height, width = grey.shape
    count, total = 0, 0
    enough = CLUSTERS * grey.size / (step * step)
    for y in range(1, height - 1, step):
        for x in range(1, width - 1, step):
            total += 1
            # Almost every pixel is like the one to its left or right.
            value = np.int64(grey[y, x])
            if abs(value - grey[y, x - 1]) < limit or abs(value - grey[y, x + 1]) < limit:
                continue
            alike = False
            for dx in range(-1, 2):
                alike = alike or abs(value - grey[y - 1, x + dx]) < limit
                alike = alike or abs(value - grey[y + 1, x + dx]) < limit
            count += not alike
        if count > enough:
            break
    return count / max(total, 1)


@njit(cache=True, nogil=True)
def _replace_impulses(
    grey: NDArray[np.uint8], median: NDArray[np.uint8], deviation: NDArray[np.uint8], limit: int
) -> None:
    """Replace what stands out from its median and has too few like it that do not."""
    height, width = grey.shape
    flat, medians, deviations = grey.reshape(-1), median.reshape(-1), deviation.reshape(-1)
    for y in range(height):
        inside = 0 < y < height - 1
        for x in range(width):
            at = y * width + x
            if deviations[at] > limit:
                if inside and 0 < x < width - 1:
                    flat[at] = _from_neighbours(flat, deviations, limit, at, width)
                else:
                    flat[at] = medians[at]


@njit(cache=True, nogil=True)
def _from_neighbours(
    grey: NDArray[np.uint8], deviation: NDArray[np.uint8], limit: int, at: int, width: int
) -> int:
    """The pixel where enough neighbours are like it, or else what they make likely.

    That is the mean of the two opposite neighbours that differ least, which lie along an edge.
    Neighbours that stand out themselves do not count; those above and left have been replaced.
    """
    value = np.int64(grey[at])
    alike, good, total = 0, 0, 0
    least, along = 256, 0
    for offset in (1, width - 1, width, width + 1):
        a, b = np.int64(grey[at - offset]), np.int64(grey[at + offset])
        good_a = np.int64(deviation[at - offset] <= limit)
        good_b = np.int64(deviation[at + offset] <= limit)
        alike += good_a * (abs(a - value) <= limit) + good_b * (abs(b - value) <= limit)
        good += good_a + good_b
        total += good_a * a + good_b * b
        # Without branches, which nothing could predict here.
        differ = abs(a - b) + 256 * (2 - good_a - good_b)
        along = (a + b + 1) >> 1 if differ < least else along
        least = min(differ, least)
    if alike >= ALIKE or good == 0:
        return int(value)
    return int(along if least < 256 else total // good)
