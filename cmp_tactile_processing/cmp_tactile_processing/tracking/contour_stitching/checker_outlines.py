"""Pretreatment and contour extraction: from an image to the outlines of its checkers.

Where a place is darker or lighter than its surroundings by a share of what they vary by, the
illumination does not matter (paper, III.A).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.image.prepared import PreparedImage

__all__ = ["CheckerOutlines", "least_deviation"]

# Width (Gaussian, in sides) of the surroundings: they hold light and dark alike.
SURROUNDINGS = 0.65
# Where they vary by less than this share of the image's contrast, or by less than so many standard
# deviations of the noise that smoothing leaves, there is no pattern.
LEAST_CONTRAST, LEAST_DEVIATIONS = 0.03, 2.0
# Surroundings are measured on pixels of this many to a side.
COARSE = 5.0
# Openings and closings go up to this share of a side.
MEND = 0.08
CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
SQUARE = np.ones((3, 3), np.uint8)
NOWHERE = 1e4


def least_deviation(image: PreparedImage) -> float:
    """Standard deviation, grey levels, by which the smoothed image varies where the pattern is."""
    # Smoothing by s leaves white noise 1 / (2 sqrt(pi) s) of its standard deviation.
    noise = image.noise / max(2 * math.sqrt(math.pi) * image.smoothing_px, 1.0)
    return max(LEAST_CONTRAST * image.contrast, LEAST_DEVIATIONS * noise)


class CheckerOutlines:
    """Outlines of the checkers of one image at several depths of erosion.

    image (H, W) float32, smoothed; side_px: side of a checker; offset: share of the surroundings'
    standard deviation by which a checker differs from their mean; least: see `least_deviation`.
    """

    def __init__(
        self, image: NDArray[np.float32], side_px: float, offset: float, least: float
    ) -> None:
        self._image = image
        self._mend = max(1, round(MEND * side_px))
        factor = max(1, int(side_px / COARSE))
        height, width = image.shape
        size = (max(width // factor, 1), max(height // factor, 1))
        coarse = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        sigma = SURROUNDINGS * side_px / factor
        mean = cv2.GaussianBlur(coarse, (0, 0), sigma)
        square = cv2.GaussianBlur(coarse * coarse, (0, 0), sigma)
        deviation = np.sqrt(np.maximum(square - mean * mean, 0))
        band = np.where(deviation > least, offset * deviation, NOWHERE).astype(np.float32)
        self._level = {True: mean - band, False: mean + band}
        self._mask: dict[bool, cv2.typing.MatLike] = {}

    def contours(self, dark: bool, erosion: int) -> Sequence[cv2.typing.MatLike]:
        """Outlines of the dark or of the light blobs, eroded by so many px; with all points."""
        if dark not in self._mask:
            level = cv2.resize(self._level[dark], self._image.shape[::-1])
            kind = cv2.CMP_LT if dark else cv2.CMP_GT
            self._mask[dark] = self._mended(cv2.compare(self._image, level, kind))
        mask = cv2.erode(self._mask[dark], SQUARE, iterations=erosion)
        return cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]

    def _mended(self, mask: cv2.typing.MatLike) -> cv2.typing.MatLike:
        """The paper's loop of openings and closings: small missing and false spots are repaired."""
        for times in range(1, self._mend + 1):
            mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, CROSS, iterations=times)
            mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, CROSS, iterations=times)
        return mask
