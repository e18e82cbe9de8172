"""Prepares a view image for detection and measurement, as far as its noise calls for it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.image.impulse_filter import ImpulseFilter
from cmp_tactile_processing.image.noise_estimate import contrast_of, noise_of
from cmp_tactile_processing.image.prepared import PreparedImage

__all__ = ["Prefilter"]

# Smoothing before saddle points and gradients are measured, px: the lens blurs by about as much.
# More where the noise is more than a share of the contrast, less where checkers are small.
SMOOTHING_PX, MOST_SMOOTHING_PX, LEAST_SMOOTHING_PX = 1.1, 2.0, 0.5
SMOOTHING_PER_NOISE = 10.0
SMOOTHING_PER_SIDE = 0.15
# Width of the Gaussian kernel to either side, in standard deviations.
KERNEL_REACH = 3.0


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
    limit = max(SMOOTHING_PER_SIDE * side_px, LEAST_SMOOTHING_PX)
    return float(min(wanted, MOST_SMOOTHING_PX, limit))


def _gaussian(sigma: float) -> NDArray[np.float32]:
    reach = max(int(np.ceil(KERNEL_REACH * sigma)), 1)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)
