"""Finds dark dots on light skin in a view image, their centres to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.image.prefilter import ImpulseFilter, noise_of
from cmp_tactile_processing.tracking.detector import NominalGrid
from paper.dot_centres import Outlines, centroids, outlines, peaks
from paper.dot_parameters import DotParameters

__all__ = ["DotDetector", "DotImage", "Dots"]

# Percentiles of the grey values that ink and skin certainly reach.
INK, SKIN = 2.0, 80.0
# Pixels darker than their surroundings' median by more than this are no skin.
NOT_SKIN = 0.3
# Standard deviation of the matched filter, in radii of a dot, and of what it subtracts: a
# Laplacian of this width answers a disc most.
MATCHED, SURROUND = 0.7, 1.6
# Outlines are taken from an image smoothed by so many radii per noise above a little, up to CALM.
CALM_PER_NOISE, LITTLE_NOISE, CALM = 4.0, 0.03, 0.45
# What salt and pepper leaves behind does as much harm as this noise, per squared share of pixels.
LIKE_NOISE = 2.5
# Dots are no nearer to each other than this share of the pitch.
APART = 0.4


@dataclass(frozen=True)
class Dots:
    """Whole dots of an image: position (N, 2) px.

    noise: of the image, as a share of the contrast of ink and skin.
    """

    position: NDArray[np.float64]
    noise: float


@dataclass(frozen=True)
class DotImage:
    """A view image prepared.  grey (H, W) uint8 without salt and pepper; darkness (H, W) float32:
    0 where the skin is, 1 where the ink is, in any light; noise: as in `Dots`."""

    grey: NDArray[np.uint8]
    darkness: NDArray[np.float32]
    noise: float


class DotDetector:
    """Finds the dots of images of one size.

    nominal: in pixels of these images; shape: (height, width), px.
    """

    def __init__(
        self, nominal: NominalGrid, shape: tuple[int, int], parameters: DotParameters
    ) -> None:
        self._nominal, self._parameters = nominal, parameters
        self._radius_px = parameters.diameter * nominal.side_px / 2
        self._impulses = ImpulseFilter(shape, 2 * self._radius_px)
        self._clean = np.empty(shape, np.uint8)

    def prepare(self, grey: NDArray[np.uint8]) -> DotImage:
        """An image (H, W) without salt and pepper, its light divided out."""
        contrast = float(np.diff(np.percentile(grey, (INK, SKIN)))[0])
        self._impulses.apply(grey, contrast, self._clean)
        clean = self._clean
        light = _light(clean, self._nominal.side_px)
        dark = 1 - clean.astype(np.float32) / light
        smooth = _blurred(dark, 0.5 * self._radius_px)
        ink = _ink_darkness(smooth, self._nominal.corners[..., 0].size)
        level = float(np.median(light)) * max(ink, 1e-3)
        replaced = np.count_nonzero(clean != grey) / grey.size
        noise = float(np.hypot(noise_of(clean) / level, LIKE_NOISE * replaced**2))
        return DotImage(clean.copy(), np.asarray(dark / ink), noise)

    def detect(self, image: DotImage) -> Dots:
        """The dots that are seen whole; any number, also none."""
        at, response = self._candidates(image.darkness)
        centre = peaks(response, at)
        to_radii = self._to_radii(centre)
        edge = outlines(self._calm(image), centre, to_radii)
        limits = self._parameters.threshold, self._parameters.window
        centre = centroids(image.darkness, centre, to_radii, *limits)
        whole = self._whole(edge, to_radii) & np.isfinite(centre).all(axis=1)
        return Dots(centre[whole], image.noise)

    def _candidates(
        self, darkness: NDArray[np.float32]
    ) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Pixels (N, 2), as (x, y), where a matched filter answers most, and its answers (H, W)."""
        sigma = MATCHED * self._radius_px
        limited = np.clip(darkness, -0.5, 1.5)
        response = _blurred(limited, sigma) - _blurred(limited, SURROUND * sigma)
        apart = max(int(APART * self._nominal.smallest_side_px), 1)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * apart + 1, 2 * apart + 1))
        top = response >= cv2.dilate(response, disc)
        top[:2], top[-2:], top[:, :2], top[:, -2:] = False, False, False, False
        y, x = np.nonzero(top)
        value = response[y, x]
        count = self._nominal.corners[..., 0].size
        typical = float(np.median(np.sort(value)[-count:])) if len(value) else 0.0
        strong = value > max(self._parameters.least_response * typical, 0.02)
        return np.stack([x[strong], y[strong]], axis=-1), response

    def _calm(self, image: DotImage) -> NDArray[np.float32]:
        """Darkness smooth enough for outlines to be those of the dots, not of the noise."""
        sigma = min(CALM_PER_NOISE * max(image.noise - LITTLE_NOISE, 0.0), CALM) * self._radius_px
        return _blurred(image.darkness, sigma) if sigma > 0 else image.darkness

    def _to_radii(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2, 2): from px to radii of a dot as the nominal projection shows it near q."""
        along_i, along_j = self._nominal.axes_near(q)
        radius = self._parameters.diameter / 2
        return np.asarray(np.linalg.inv(radius * np.stack([along_j, along_i], axis=-1)))

    def _whole(self, edge: Outlines, to_radii: NDArray[np.float64]) -> NDArray[np.bool_]:
        settings = self._parameters
        area = edge.area * np.abs(np.linalg.det(to_radii))
        area /= np.nanmedian(area) if np.isfinite(area).any() else 1.0
        return np.asarray(
            (area > settings.least_area)
            & (area < settings.most_area)
            & (edge.elongation < settings.most_elongation)
            & (edge.residual < settings.most_residual)
        )


def _blurred(image: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.float32)


def _light(grey: NDArray[np.uint8], side_px: float) -> NDArray[np.float32]:
    """Grey of the skin around each pixel: the mean of the pixels that are no ink."""
    size = 2 * round(side_px) + 1
    typical = cv2.medianBlur(grey, size).astype(np.float32)
    skin = (grey > (1 - NOT_SKIN) * typical).astype(np.float32)
    share = cv2.blur(skin, (size, size))
    total = cv2.blur(skin * grey, (size, size))
    with np.errstate(divide="ignore", invalid="ignore"):
        light = np.where(share > 0.1, total / share, typical)
    return np.asarray(np.maximum(light, 1.0), dtype=np.float32)


def _ink_darkness(smooth: NDArray[np.float32], count: int) -> float:
    """Typical darkness in the middle of the `count` dots of an image."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))
    tops = np.sort(smooth[smooth >= cv2.dilate(smooth, disc)])[-count:]
    return max(float(np.median(tops)), 0.02) if len(tops) else 1.0
