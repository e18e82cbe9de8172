"""What a picture itself tells of its light and noise."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from cmp_tactile_processing.measured.grid import Grid

__all__ = ["light_peak_ratio", "pattern_parts", "power_snr_db", "two_peaks"]

GREYS = 256
# Standard deviation of the histogram's smoothing, grey levels; against the noise of the counts.
SMOOTHING = 3.0
TILES = 4


def pattern_parts(image: NDArray[np.uint8], grids: Mapping[str, Grid]) -> list[NDArray[np.uint8]]:
    """Of a frame (H, W), the rectangle in each view that holds all of its true corners."""
    parts = []
    for grid in grids.values():
        corners = grid.corners_frame.reshape(-1, 2)
        (left, top), (right, bottom) = np.nanmin(corners, axis=0), np.nanmax(corners, axis=0)
        parts.append(image[int(top) : int(bottom) + 1, int(left) : int(right) + 1])
    return parts


def light_peak_ratio(parts: list[NDArray[np.uint8]]) -> float:
    """How unevenly the light skin is lit: its darkest over its brightest peak.

    In each of TILES x TILES tiles of each part, the peak of the histogram of its brighter half.
    """
    peaks = [
        float(two_peaks([tile])[1])
        for part in parts
        for band in np.array_split(part, TILES)
        for tile in np.array_split(band, TILES, axis=1)
    ]
    return min(peaks) / max(*peaks, 1.0)


def two_peaks(parts: list[NDArray[np.uint8]]) -> tuple[int, int]:
    """Greys of the histogram's peaks among the darker and among the brighter half of the pixels."""
    counts = sum(np.bincount(part.ravel(), minlength=GREYS) for part in parts)
    smooth = gaussian_filter1d(np.asarray(counts, dtype=np.float64), SMOOTHING, mode="constant")
    middle = int(np.searchsorted(np.cumsum(counts), 0.5 * np.sum(counts)))
    dark = int(np.argmax(smooth[: middle + 1]))
    light = middle + int(np.argmax(smooth[middle:]))
    return dark, light


def power_snr_db(clean: NDArray[np.uint8], noisy: NDArray[np.uint8]) -> float:
    """Mean square of the picture over that of what was added to it, dB; inf for nothing."""
    signal = clean.astype(np.float64)
    noise = float(np.mean((noisy - signal) ** 2))
    return float("inf") if noise == 0 else 10 * float(np.log10(np.mean(signal**2) / noise))
