"""The fault of an image in which nothing was found, from its grey values alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.measured import GridFault

# Steps between the pixels that are looked at.  Two primes: checkers of no size fall in step with
# both, so light and dark ones are met equally often.
ROW_STEP, COL_STEP = 7, 11
# An image of fewer rows or columns is looked at whole.
SMALL_SIDE = 120
# Columns between pixels that are compared to distinguish picture from noise: what a camera or a
# median of 3 x 3 smooths is independent at that distance.
DISTANCES = (4, 5)
# 95 % of a dark image are below this; the light checkers of a normal frame have 100 to 250.
DARK_BELOW = 12
# 80 % of an overexposed image are at the end of the scale; glare that leaves half of the pattern
# to be seen is not.
SATURATED, SATURATED_SHARE = 250, 0.8
# An image without contrast is overexposed above this, whatever its camera's largest value is.
BRIGHT_ABOVE = 235
# Contrast of less than this, in grey levels and in standard deviations of the noise, is none.
# Noise alone shows up to 0.44 of its standard deviation in 4000 pixels, at 3 standard errors.
LEAST_CONTRAST, LEAST_CONTRAST_IN_NOISE = 4.0, 0.6


def image_fault(grey: NDArray[np.uint8]) -> tuple[GridFault, str]:
    """DARK, OVEREXPOSED or NO_CONTRAST with what was measured, or NONE with an empty text.

    grey (H, W) uint8: the part of a view image that should hold the pattern.  NONE says that the
    grey values are those of a picture of something, not that it is a pattern.
    Raises FrameError for an image without pixels.
    """
    if grey.size == 0:
        msg = f"image: found shape {grey.shape}, expected pixels"
        raise FrameError(msg)
    row_step, col_step = (
        1 if side < SMALL_SIDE else step
        for side, step in zip(grey.shape, (ROW_STEP, COL_STEP), strict=True)
    )
    sample = grey[::row_step, ::col_step]
    low, middle, high = _quantiles(sample, (1 - SATURATED_SHARE, 0.5, 0.95))
    if high < DARK_BELOW:
        return GridFault.DARK, f"too dark: 95 % of the pixels are at {high} of 255 or below"
    if low >= SATURATED:
        share = np.count_nonzero(sample >= SATURATED) / sample.size
        return GridFault.OVEREXPOSED, f"too bright: {share:.0%} of the pixels are saturated"
    contrast, noise = _contrast_and_noise(grey, row_step, col_step)
    if contrast >= max(LEAST_CONTRAST, LEAST_CONTRAST_IN_NOISE * noise):
        return GridFault.NONE, ""
    seen = f"light and dark differ by {contrast:.0f} grey levels at a noise of {noise:.1f}"
    if middle >= BRIGHT_ABOVE:
        return GridFault.OVEREXPOSED, f"too bright: around {middle} of 255, {seen}"
    if middle < DARK_BELOW:
        return GridFault.DARK, f"too dark: around {middle} of 255, {seen}"
    return GridFault.NO_CONTRAST, f"no contrast: {seen}, around {middle} of 255"


def _quantiles(sample: NDArray[np.uint8], shares: tuple[float, ...]) -> list[int]:
    """The smallest grey values that so large shares of the sample do not exceed."""
    counted = np.bincount(sample.ravel(), minlength=256).cumsum()
    return [int(item) for item in counted.searchsorted(np.array(shares) * sample.size)]


def _contrast_and_noise(
    grey: NDArray[np.uint8], row_step: int, col_step: int
) -> tuple[float, float]:
    """Difference of light and dark, and standard deviation of the noise, grey levels.

    Pixels a few columns apart have the picture in common, but not the noise, whatever its
    distribution: their covariance is the picture's variance, which is a quarter of the squared
    difference.  It is negative where the distance is about a checker's side, and 0 at half of
    that, which two distances cannot both be.
    """
    width = grey.shape[1]
    reach = max(DISTANCES)
    if width <= reach:
        return 0.0, 0.0
    common = 0.0
    first = _centred(grey[::row_step, : width - reach : col_step])
    variance = float(first @ first) / first.size
    for distance in DISTANCES:
        second = _centred(grey[::row_step, distance : width - reach + distance : col_step])
        common = max(common, abs(float(first @ second)) / first.size)
    return 2 * common**0.5, max(variance - common, 0.0) ** 0.5


def _centred(pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    values = pixels.astype(np.float32).ravel()
    values -= values.mean()
    return values
