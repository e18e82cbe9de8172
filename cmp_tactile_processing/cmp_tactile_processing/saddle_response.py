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
        self._found = np.empty((capacity, 3))

    def candidates(self, smooth: NDArray[np.float32], threshold: float) -> NDArray[np.float64]:
        """Local maxima of the response, (n, 3): x, y in px and the saddle's amplitude, grey levels.

        smooth: (H, W) smoothed image.  threshold: least amplitude, grey levels.  The strongest
        `capacity` ones where there are more.
        """
        least = np.float32(8.0 * threshold * threshold)
        _respond(smooth, self._radius, self._response)
        while True:
            count = _local_maxima(self._response, self._reach, least, self._found)
            if count <= len(self._found):
                break
            least *= np.float32(2.0)
        found = self._found[:count]
        return np.column_stack([found[:, :2], np.sqrt(found[:, 2] / 8.0)])


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
    response: NDArray[np.float32], reach: int, least: np.float32, found: NDArray[np.float64]
) -> int:
    """Fills found (x, y, response at the parabola's top); returns how many there are."""
    height, width = response.shape
    count = 0
    margin = reach + 1
    for y in range(margin, height - margin):
        row = response[y]
        inner = row[margin : width - margin]
        for k in range(len(inner)):
            value = inner[k]
            if value < least:
                continue
            x = k + margin
            if value < row[x - 1] or value <= row[x + 1]:
                continue
            if not _is_peak(response, x, y, reach, value):
                continue
            if count < len(found):
                left, right = row[x - 1], row[x + 1]
                above, below = response[y - 1, x], response[y + 1, x]
                found[count, 0] = x + _vertex(left, value, right)
                found[count, 1] = y + _vertex(above, value, below)
                found[count, 2] = value
            count += 1
    return count


@njit(cache=True, nogil=True)
def _is_peak(response: NDArray[np.float32], x: int, y: int, reach: int, value: np.float32) -> bool:
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
