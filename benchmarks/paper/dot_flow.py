"""Follows dots from frame to frame by pyramidal Lucas-Kanade optical flow."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from paper.dot_parameters import DotParameters

__all__ = ["flow"]


def flow(
    images: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    last: NDArray[np.float64],
    side_px: float,
    parameters: DotParameters,
) -> NDArray[np.float64]:
    """Where markers (M, 2) px of the first image are in the second; NaN where that is in doubt.

    images (H, W) grey.  In doubt is what the flow back does not take to where it came from.
    """
    size = max(round(parameters.flow_window * side_px), 5) | 1
    moved = partial(
        cv2.calcOpticalFlowPyrLK,
        winSize=(size, size),
        maxLevel=parameters.flow_levels,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01),
    )
    before, now = images
    start = np.ascontiguousarray(last, dtype=np.float32).reshape(-1, 1, 2)
    end, found, _ = moved(before, now, start, np.empty_like(start))
    back, returned, _ = moved(now, before, end, np.empty_like(start))
    miss = np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    sure = (found.ravel() == 1) & (returned.ravel() == 1) & (miss < parameters.flow_return)
    return np.where(sure[:, None], end.reshape(-1, 2).astype(np.float64), np.nan)
