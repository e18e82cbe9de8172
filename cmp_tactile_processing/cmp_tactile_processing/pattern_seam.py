"""Finds where another checkerboard lies over the pattern and its gridlines seem to go on."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["drop_beyond_seams"]

# The displacement of a gel changes evenly along a gridline: its second difference stays below this
# share of a side (0.17 under the sharpest of the sample frames' contacts), and what detected
# corners are off by in px.
LARGEST_BEND, DETECTED_PX = 0.2, 0.8
# Where all corners scatter, a seam stands out from the median by this factor.
TYPICAL_BENDS = 5.0
# Fewer bent corners are single false ones.
FEWEST_BENT = 3
# A part of the grid hangs together by blocks of 3 x 3 corners of which none is bent and so many
# are known: where two patterns meet, a line or two go on evenly by chance.
KNOWN_IN_BLOCK = 6


def drop_beyond_seams(corners: NDArray[np.float64], nominal: NDArray[np.float64]) -> int:
    """Set to NaN in `corners` what a seam parts from the largest part; returns how many.

    corners, nominal (rows, cols, 2) px.
    """
    bend = np.zeros(corners.shape[:2])
    _measure_bends(corners - nominal, nominal, bend)
    bent = bend > max(1.0, TYPICAL_BENDS * float(np.median(bend)))
    if np.count_nonzero(bent) < FEWEST_BENT:
        return 0
    known = np.isfinite(corners[..., 0])
    part = np.zeros(bent.shape, dtype=np.int64)
    parts = _number_parts(known, bent, part, np.empty((bent.size, 2), dtype=np.int64))
    beyond = known & _beyond(bent, part, parts)
    corners[beyond] = np.nan
    return int(np.count_nonzero(beyond))


def _beyond(bent: NDArray[np.bool_], part: NDArray[np.int64], parts: int) -> NDArray[np.bool_]:
    """Corners of all parts at a seam but the largest, and what lies along it in no part."""
    seam = _grown(bent)
    largest = int(np.bincount(part.ravel(), minlength=2)[1:].argmax()) + 1
    beyond = seam.copy()
    for index in range(1, parts + 1):
        within = _grown(part == index)
        if index != largest and (_grown(within) & bent).any():
            beyond |= within
    return np.asarray(beyond & ~_grown(part == largest))


def _grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """With the eight neighbours of every corner of it."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


@njit(cache=True, nogil=True)
def _measure_bends(
    displacement: NDArray[np.float64], nominal: NDArray[np.float64], bend: NDArray[np.float64]
) -> None:
    """Second differences along both gridlines, the larger, as a share of the largest allowed."""
    rows, cols = bend.shape
    for i in range(rows):
        for j in range(cols):
            for di, dj in ((1, 0), (0, 1)):
                if i < di or j < dj or i + di >= rows or j + dj >= cols:
                    continue
                total = length = 0.0
                for d in range(2):
                    before, after = displacement[i - di, j - dj, d], displacement[i + di, j + dj, d]
                    total += (before - 2 * displacement[i, j, d] + after) ** 2
                    length += (nominal[i + di, j + dj, d] - nominal[i, j, d]) ** 2
                share = np.sqrt(total) / (LARGEST_BEND * np.sqrt(length) + DETECTED_PX)
                if not np.isnan(share):
                    bend[i, j] = max(bend[i, j], share)


@njit(cache=True, nogil=True)
def _is_block(known: NDArray[np.bool_], bent: NDArray[np.bool_], i: int, j: int) -> bool:
    """Whether the block around corner (i, j) is whole enough and nowhere bent."""
    if i < 1 or j < 1 or i + 1 >= known.shape[0] or j + 1 >= known.shape[1]:
        return False
    count = 0
    for a in range(i - 1, i + 2):
        for b in range(j - 1, j + 2):
            if known[a, b] and bent[a, b]:
                return False
            count += known[a, b]
    return count >= KNOWN_IN_BLOCK


@njit(cache=True, nogil=True)
def _number_parts(
    known: NDArray[np.bool_],
    bent: NDArray[np.bool_],
    part: NDArray[np.int64],
    queue: NDArray[np.int64],
) -> int:
    """Number the middles of the blocks that hang together, from 1; how many parts there are."""
    parts = 0
    for i in range(known.shape[0]):
        for j in range(known.shape[1]):
            if part[i, j] == 0 and _is_block(known, bent, i, j):
                parts += 1
                _flood(known, bent, part, queue, (i, j, parts))
    return parts


@njit(cache=True, nogil=True)
def _flood(
    known: NDArray[np.bool_],
    bent: NDArray[np.bool_],
    part: NDArray[np.int64],
    queue: NDArray[np.int64],
    start: tuple[int, int, int],
) -> None:
    part[start[0], start[1]] = start[2]
    queue[0, 0], queue[0, 1] = start[0], start[1]
    head, tail = 0, 1
    while head < tail:
        i, j = queue[head]
        head += 1
        for di, dj in ((-1, 0), (0, 1), (1, 0), (0, -1)):
            a, b = i + di, j + dj
            if not (0 <= a < part.shape[0] and 0 <= b < part.shape[1]) or part[a, b] > 0:
                continue
            if _is_block(known, bent, a, b):
                part[a, b] = start[2]
                queue[tail, 0], queue[tail, 1] = a, b
                tail += 1
