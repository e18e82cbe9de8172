"""What the detectors and the measurements see of a view image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["PreparedImage"]


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
