"""A view image prepared for detection and measurement, as far as its noise calls for it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part

Image = NDArray[np.float32] | NDArray[np.uint8]
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
# An image with more than this share of pixels that stand out from all 8 neighbours has salt and
# pepper.
SALT_AND_PEPPER = 0.001
# An impulse differs from its neighbours by more than this share of the contrast, this many grey
# levels, and this many deviations of the noise,
MIN_IMPULSE_CONTRAST = 0.2
MIN_IMPULSE_GREY = 12.0
MIN_IMPULSE_NOISE_STD = 4.0
# and by more than this share of what the centre of a small checker differs by.
MIN_IMPULSE_CHECKER_SHARE = 0.75
# To decide whether there is salt and pepper it takes more: the tip of a sharp checker stands out by
# up to 0.25 of the contrast.
CERTAIN_CONTRAST = 0.3
# What noise may ask for at most, as a share of the contrast.
MOST_BY_NOISE = 0.4
# Neighbours alike that make a pixel part of the pattern: a checker's tip has as many.
MIN_EQUAL_NEIGHBOURS = 2
# Standard normal: root of the sum of squares of (1, -2, 1), and 30th percentile of its modulus.
SECOND_DIFFERENCE, LOW_QUANTILE, LOW_VALUE = 6**0.5, 0.3, 0.385
# Standard deviation of the smoothing before saddle points and gradients are measured: a lens blurs
# by about as much.  It is more if the noise exceeds a share of the contrast, less if checkers are
# small.
SMOOTHING_PX = 1.1
MAX_SMOOTHING_PX = 2.0
MIN_SMOOTHING_PX = 0.5
SMOOTHING_PER_NOISE = 10.0
SMOOTHING_PER_SIDE = 0.15
# Width of the Gaussian kernel to either side, in standard deviations.
KERNEL_REACH = 3.0


@dataclass(frozen=True)
class PreparedImage:
    """The part of a view image that holds the pattern, ready to be measured.

    grey (H, W) uint8: without salt and pepper; smooth (H, W) float32: `grey` convolved with a
    Gaussian of `smoothing_px`; noise: standard deviation of `grey`'s noise, grey levels;
    contrast: grey levels between light and dark, from the 5th to the 95th percentile;
    replaced: pixels of `grey` that were salt or pepper, (H, W) bool, None where none is.
    The arrays are buffers that the next image overwrites.
    """

    grey: NDArray[np.uint8]
    smooth: NDArray[np.float32]
    smoothing_px: float
    noise: float
    contrast: float
    replaced: NDArray[np.bool_] | None = None

    @property
    def smooth_noise(self) -> float:
        """Standard deviation of the noise of `smooth`, grey levels."""
        smoothing = max(self.smoothing_px, MIN_SMOOTHING_PX)
        return float(self.noise / (2.0 * np.sqrt(np.pi) * smoothing))


@kernel
def sample(image: Image, x: float, y: float) -> float:
    """Bilinear grey level at (x, y); NaN outside."""
    height, width = image.shape
    if not (x >= 0.0 and y >= 0.0 and x < width - 1 and y < height - 1):
        return np.nan
    return inner_sample(image, x, y)


@kernel_part
def inner_sample(image: Image, x: float, y: float) -> float:
    """Bilinear grey level at (x, y), which lies inside."""
    left, top = int(x), int(y)
    u, v = x - left, y - top
    # Unsigned: no index could count from the end.
    first, upper = np.uint64(left), np.uint64(top)
    second, lower = np.uint64(left + 1), np.uint64(top + 1)
    above = image[upper, first] * (1.0 - u) + image[upper, second] * u
    below = image[lower, first] * (1.0 - u) + image[lower, second] * u
    return float(above * (1.0 - v) + below * v)


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
    return float(max(_noise(np.ascontiguousarray(grey), step, flatness, high_pass), QUANTISATION))


def contrast_of(grey: NDArray[np.uint8]) -> float:
    """Grey levels between the 5th and the 95th percentile."""
    step = max(min(grey.shape) // SAMPLES_PER_SIDE, 1)
    return float(_contrast(grey, step, np.zeros(256, np.int64)))


@kernel_part
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


@kernel
def _contrast(grey: NDArray[np.uint8], step: int, histogram: NDArray[np.int64]) -> float:
    for y in range(step // 2, grey.shape[0], step):
        for x in range(step // 2, grey.shape[1], step):
            histogram[grey[y, x]] += 1
    return _quantile(histogram, 0.95) - _quantile(histogram, 0.05)


@kernel_part
def _slope(grey: NDArray[np.uint8], at: int, width: int) -> int:
    """Sum of the differences across a pixel, from pixels outside the high-pass's window."""
    # Unsigned: no index could count from the end.
    here, down = np.uint64(at), np.uint64(REACH * width)
    side = np.uint64(REACH)
    across = abs(np.int32(grey[here + side]) - np.int32(grey[here - side]))
    return int(across + abs(np.int32(grey[here + down]) - np.int32(grey[here - down])))


@kernel_part
def _fourth(grey: NDArray[np.uint8], at: int, step: int) -> int:
    """Fourth difference about a pixel along a step."""
    here, one, two = np.uint64(at), np.uint64(step), np.uint64(2 * step)
    ends = np.int32(grey[here - two]) + np.int32(grey[here + two])
    beside = np.int32(grey[here - one]) + np.int32(grey[here + one])
    return int(ends - 4 * beside + 6 * np.int32(grey[here]))


@kernel
def _noise(
    grey: NDArray[np.uint8],
    step: int,
    flatness: NDArray[np.int64],
    high_pass: NDArray[np.int64],
) -> float:
    height, width = grey.shape
    flat = grey.reshape(-1)
    for y in range(REACH, height - REACH, step):
        for x in range(REACH, width - REACH, step):
            flatness[_slope(flat, y * width + x, width)] += 1
    limit = _quantile(flatness, FLATTEST_SHARE) + 0.5
    for y in range(REACH, height - REACH, step):
        for x in range(REACH, width - REACH, step):
            at = y * width + x
            if _slope(flat, at, width) > limit:
                continue
            total = _fourth(flat, at - 2, width) + _fourth(flat, at + 2, width)
            total -= 4 * (_fourth(flat, at - 1, width) + _fourth(flat, at + 1, width))
            total += 6 * _fourth(flat, at, width)
            high_pass[min(abs(total), len(high_pass) - 1)] += 1
    return _quantile(high_pass, 0.5) / (MEDIAN_OF_NORMAL * HIGH_PASS_GAIN)


class ImpulseFilter:
    """Replaces salt and pepper in images of one size, and leaves all other pixels as they are.

    shape: (height, width), px; side_px: side of a checker.
    """

    def __init__(self, shape: tuple[int, int], side_px: float) -> None:
        self._median = np.empty(shape, np.uint8)
        self._deviation = np.empty(shape, np.uint8)
        self._step = 3 if shape[0] * shape[1] > 90_000 else 1
        peak = MIN_IMPULSE_CHECKER_SHARE * (1 - np.cos(np.pi / max(side_px, 2.0)))
        self._share_of_contrast = max(MIN_IMPULSE_CONTRAST, float(peak))

    def apply(self, grey: NDArray[np.uint8], contrast: float, clean: NDArray[np.uint8]) -> bool:
        """Copy `grey` (H, W) into `clean` without salt and pepper; whether there was any."""
        np.copyto(clean, grey)
        by_noise = min(
            MIN_IMPULSE_NOISE_STD * _rough_noise(clean, self._step), MOST_BY_NOISE * contrast
        )
        limit = max(MIN_IMPULSE_GREY, self._share_of_contrast * contrast, by_noise)
        share = _share_standing_out(clean, self._step, max(limit, CERTAIN_CONTRAST * contrast))
        if share <= SALT_AND_PEPPER:
            return False
        # The second pass finds the rest of clusters.
        self._replace(clean, int(limit))
        self._replace(clean, int(limit))
        return True

    def _replace(self, clean: NDArray[np.uint8], limit: int) -> None:
        cv2.medianBlur(clean, 3, dst=self._median)
        cv2.absdiff(clean, self._median, dst=self._deviation)
        _replace_impulses(clean, self._median, self._deviation, limit)


@kernel
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


@kernel
def _share_standing_out(grey: NDArray[np.uint8], step: int, limit: float) -> float:
    """Share of a lattice of pixels that have no neighbour alike.

    Counts only until it is more than SALT_AND_PEPPER.
    """
    height, width = grey.shape
    count, total = 0, 0
    enough = SALT_AND_PEPPER * grey.size / (step * step)
    # Grey levels are whole numbers.
    flat, least = grey.reshape(-1), np.int32(np.ceil(limit))
    for y in range(1, height - 1, step):
        for x in range(1, width - 1, step):
            total += 1
            # Almost every pixel is like the one to its left or right.
            at = np.uint64(y * width + x)
            left, right = flat[at - np.uint64(1)], flat[at + np.uint64(1)]
            value = np.int32(flat[at])
            if abs(value - np.int32(left)) < least or abs(value - np.int32(right)) < least:
                continue
            alike = False
            for dx in range(-1, 2):
                alike = alike or abs(value - grey[y - 1, x + dx]) < limit
                alike = alike or abs(value - grey[y + 1, x + dx]) < limit
            count += not alike
        if count > enough:
            break
    return count / max(total, 1)


@kernel
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


@kernel_part
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
    if alike >= MIN_EQUAL_NEIGHBOURS or good == 0:
        return int(value)
    return int(along if least < 256 else total // good)


class Prefilter:
    """Prepares images of one size; its buffers are overwritten by the next image.

    shape: (height, width), px; side_px: side of a checker.
    """

    def __init__(self, shape: tuple[int, int], side_px: float) -> None:
        self._side_px = side_px
        self._impulses = ImpulseFilter(shape, side_px)
        self._clean = np.empty(shape, np.uint8)
        self._replaced = np.empty(shape, np.bool_)
        self._smooth = np.empty(shape, np.float32)

    def prepare(self, grey: NDArray[np.uint8]) -> PreparedImage:
        """The image without salt and pepper, smoothed by what noise and checker side call for.

        grey: (H, W) uint8.
        """
        contrast, clean, replaced = contrast_of(grey), self._clean, None
        if self._impulses.apply(grey, contrast, clean):
            replaced = np.not_equal(grey, clean, out=self._replaced)
            contrast = contrast_of(clean)
        noise = noise_of(clean)
        sigma = smoothing_for(noise, contrast, self._side_px)
        kernel = _gaussian(sigma)
        cv2.sepFilter2D(clean, cv2.CV_32F, kernel, kernel, dst=self._smooth)
        return PreparedImage(clean, self._smooth, sigma, noise, contrast, replaced)


def smoothing_for(noise: float, contrast: float, side_px: float) -> float:
    """Standard deviation of the smoothing Gaussian, px."""
    wanted = SMOOTHING_PX + SMOOTHING_PER_NOISE * max(noise / max(contrast, 1.0) - 0.03, 0.0)
    limit = max(SMOOTHING_PER_SIDE * side_px, MIN_SMOOTHING_PX)
    return float(min(wanted, MAX_SMOOTHING_PX, limit))


@lru_cache(maxsize=64)
def _gaussian(sigma: float) -> NDArray[np.float32]:
    reach = max(int(np.ceil(KERNEL_REACH * sigma)), 1)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)
