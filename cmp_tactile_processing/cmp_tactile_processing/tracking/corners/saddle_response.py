"""Where in an image four checkers meet: the second circular harmonic around each pixel."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["SaddleResponse"]

# Radius of the ring in sides of a checker: inside the four checkers, clear of their far corners.
RING_RADIUS = 0.3
# A candidate is the strongest response within this many sides.
SUPPRESSION_RADIUS = 0.28
# Share of the odd part (what differs on opposite sides, as at an edge) that is taken off.
ODD_WEIGHT = 1.0


class SaddleResponse:
    """Candidates for corners in images of one size; buffers are kept from image to image.

    shape: (height, width) px; side_px: side of a checker; capacity: most candidates returned.
    """

    def __init__(self, shape: tuple[int, int], side_px: float, capacity: int) -> None:
        self._radius = max(round(RING_RADIUS * side_px), 1)
        self._reach = max(round(SUPPRESSION_RADIUS * side_px), 1)
        self._response = np.zeros(shape, dtype=np.float32)
        self._highest = np.empty((2, shape[1]), dtype=np.float32)
        self._found = np.empty((capacity, 2))

    def candidates(self, smooth: NDArray[np.float32], threshold: float) -> NDArray[np.float64]:
        """Local maxima of the response, (n, 2) px.

        smooth: (H, W) smoothed image.  threshold: least amplitude, grey levels.  The strongest
        `capacity` ones where there are more.
        """
        least = np.float32(8.0 * threshold * threshold)
        _respond(smooth, self._radius, self._response)
        while True:
            count = _local_maxima(self._response, self._reach, least, self._found, self._highest)
            if count <= len(self._found):
                break
            least *= np.float32(2.0)
        return np.array(self._found[:count])


@njit(cache=True, nogil=True, fastmath=True)
def _respond(smooth: NDArray[np.float32], radius: int, response: NDArray[np.float32]) -> None:
    """Even second harmonic of the ring's eight samples, less its odd part; 8 a^2 for a corner
    whose dark and light quadrants differ by a + a."""
    height, width = smooth.shape
    r, d = radius, max(round(radius * 0.7071), 1)
    count = width - 2 * r
    odd_weight = np.float32(ODD_WEIGHT)
    for y in range(r, height - r):
        # Slices that start at the first sample: indices from 0 let the loop be vectorised.
        north, south = smooth[y - r, r : r + count], smooth[y + r, r : r + count]
        west, east = smooth[y, :count], smooth[y, 2 * r : 2 * r + count]
        nw, ne = smooth[y - d, r - d : r - d + count], smooth[y - d, r + d : r + d + count]
        sw, se = smooth[y + d, r - d : r - d + count], smooth[y + d, r + d : r + d + count]
        out = response[y, r : r + count]
        for x in range(count):
            straight = east[x] + west[x] - north[x] - south[x]
            diagonal = ne[x] + sw[x] - nw[x] - se[x]
            odd = (east[x] - west[x]) ** 2 + (north[x] - south[x]) ** 2
            odd += (ne[x] - sw[x]) ** 2 + (nw[x] - se[x]) ** 2
            out[x] = straight * straight + diagonal * diagonal - odd_weight * odd


@njit(cache=True, nogil=True)
def _local_maxima(
    response: NDArray[np.float32],
    reach: int,
    least: np.float32,
    found: NDArray[np.float64],
    highest: NDArray[np.float32],
) -> int:
    """Fills found (x, y at the parabolas' tops); returns how many there are.

    highest (2, W): scratch.  A block of (reach + 1)^2 pixels holds one maximum at most.
    """
    height, width = response.shape
    count = 0
    margin, block = reach + 1, reach + 1
    for top in range(margin, height - margin, block):
        bottom = min(top + block, height - margin)
        _highest_of_columns(response, top, bottom, highest[0])
        _highest_to_the_right(highest[0], block, highest[1])
        for left in range(margin, width - margin, block):
            right = min(left + block, width - margin)
            value = highest[1, left]
            if value < least or _is_outdone(highest[0], value, left, right, reach):
                continue
            x, y = _last_place(response, (top, bottom, left, right), value)
            if not _is_peak(response, x, y, reach, value):
                continue
            if count < len(found):
                row = response[y]
                found[count, 0] = x + _vertex(row[x - 1], value, row[x + 1])
                found[count, 1] = y + _vertex(response[y - 1, x], value, response[y + 1, x])
            count += 1
    return count


@njit(cache=True, nogil=True, fastmath=True)
def _highest_of_columns(
    response: NDArray[np.float32], top: int, bottom: int, highest: NDArray[np.float32]
) -> None:
    """Maximum of each column of some rows."""
    for x in range(len(highest)):
        highest[x] = response[top, x]
    for y in range(top + 1, bottom):
        row = response[y]
        for x in range(len(highest)):
            highest[x] = max(highest[x], row[x])


@njit(cache=True, nogil=True, fastmath=True)
def _highest_to_the_right(
    values: NDArray[np.float32], count: int, highest: NDArray[np.float32]
) -> None:
    """Maximum of each value and the following ones, `count` in all."""
    highest[:] = values
    inner = highest[: len(values) - count]
    for shift in range(1, count):
        shifted = values[shift : shift + len(inner)]
        for x in range(len(inner)):
            inner[x] = max(inner[x], shifted[x])


@njit(cache=True, nogil=True)
def _is_outdone(
    highest: NDArray[np.float32], value: np.float32, left: int, right: int, reach: int
) -> bool:
    """Whether the columns from left to right that reach a value are near a higher one, or none."""
    first, last = left, right - 1
    while first < right and highest[first] < value:
        first += 1
    while last > first and highest[last] < value:
        last -= 1
    outdone = first == right
    for x in range(last - reach, min(first + reach + 1, len(highest))):
        outdone |= highest[x] > value
    return outdone


@njit(cache=True, nogil=True)
def _last_place(
    response: NDArray[np.float32], block: tuple[int, int, int, int], value: np.float32
) -> tuple[int, int]:
    """The last pixel (x, y) of a block (top, bottom, left, right) that has a value."""
    top, bottom, left, right = block
    for y in range(bottom - 1, top - 1, -1):
        for x in range(right - 1, left - 1, -1):
            if response[y, x] == value:
                return x, y
    return left, top


@njit(cache=True, nogil=True)
def _is_peak(response: NDArray[np.float32], x: int, y: int, reach: int, value: np.float32) -> bool:
    if response[y - 1, x] > value or response[y + 1, x] >= value:
        return False
    for dy in range(-reach, reach + 1):
        line = response[y + dy]
        for dx in range(-reach, reach + 1):
            other = line[x + dx]
            if other > value or (other == value and (dy > 0 or (dy == 0 and dx > 0))):
                return False
    return True


@njit(cache=True, nogil=True)
def _vertex(before: float, top: float, after: float) -> float:
    bend = before - 2.0 * top + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0
