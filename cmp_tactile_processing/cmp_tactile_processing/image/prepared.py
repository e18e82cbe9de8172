"""What the detectors and the measurements see of a view image, between its pixels as well."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part

Image = NDArray[np.float32] | NDArray[np.uint8]


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
