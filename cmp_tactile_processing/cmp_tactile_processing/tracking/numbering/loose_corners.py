"""Numbered corners that lie where their neighbours in the grid would have none."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["drop_loose_corners"]

# A corner lies within this share of a side, and what detected corners are off by in px, of where
# its neighbours put it.
LARGEST_MISFIT, DETECTED_PX = 0.3, 1.5


def drop_loose_corners(corners: NDArray[np.float64], nominal: NDArray[np.float64]) -> None:
    """Set to NaN in `corners` what most pairs of neighbours contradict.

    corners, nominal (rows, cols, 2) px.  Two neighbours in a line with a corner tell where it
    lies, less what the nominal grid bends between them; so does a single neighbour where no pair
    is known, by the nominal step.  A corner without neighbours is dropped.
    """
    loose = np.empty(corners.shape[:2], dtype=np.bool_)
    _find_loose(corners - nominal, nominal, loose)
    corners[loose] = np.nan


@njit(cache=True, nogil=True)
def _find_loose(
    displacement: NDArray[np.float64], nominal: NDArray[np.float64], loose: NDArray[np.bool_]
) -> None:
    rows, cols = loose.shape
    for i in range(rows):
        for j in range(cols):
            pairs = _votes(displacement, nominal, (i, j), True)
            if pairs[0] + pairs[1] == 0:
                pairs = _votes(displacement, nominal, (i, j), False)
            loose[i, j] = pairs[0] <= pairs[1]


@njit(cache=True, nogil=True)
def _votes(
    displacement: NDArray[np.float64],
    nominal: NDArray[np.float64],
    corner: tuple[int, int],
    in_pairs: bool,
) -> tuple[int, int]:
    """How many pairs of neighbours, or single ones, agree with a corner's place, and disagree."""
    agree = against = 0
    i, j = corner
    rows, cols = displacement.shape[:2]
    for di, dj in ((-1, 0), (0, 1), (1, 0), (0, -1)):
        a, b = i + di, j + dj
        for reach in (2, -1):
            c, d = i + reach * di, j + reach * dj
            # The pair on either side is met once from each of them.
            if reach == -1 and di + dj < 0:
                continue
            if min(a, b) < 0 or a >= rows or b >= cols:
                continue
            if in_pairs and (min(c, d) < 0 or c >= rows or d >= cols):
                continue
            total = length = 0.0
            for axis in range(2):
                expected = displacement[a, b, axis]
                if in_pairs:
                    far = displacement[c, d, axis]
                    expected = 2 * expected - far if reach == 2 else (expected + far) / 2
                total += (displacement[i, j, axis] - expected) ** 2
                length += (nominal[i, j, axis] - nominal[a, b, axis]) ** 2
            if np.isnan(total):
                continue
            if np.sqrt(total) <= LARGEST_MISFIT * np.sqrt(length) + DETECTED_PX:
                agree += 1
            else:
                against += 1
    return agree, against
