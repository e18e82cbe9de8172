"""The grey of the print at a material point, as compiled code evaluates it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["CHECKERS", "DOTS", "InkArrays", "ink_at", "ink_on"]

CHECKERS, DOTS = 0, 1


class InkArrays(NamedTuple):
    """What `ink_at` reads; lengths in m, greys as the renderer gives them.

    kind: CHECKERS or DOTS.  first_dark: 1 where the checker outside corner (0, 0) is dark.
    strays (h, w, 2) float32 m: by how much the print strays, on a lattice that starts at
    (stray_x, stray_y) with stray_per points a metre; empty for none.  stray_slope: its largest
    change over a distance, per that distance.
    blobs (k, 7): centre x, y; matrix that maps the blob to the unit circle, row by row; shorter
    half-axis.  blob_grey (k,).  bins (h, w + 1): bin (row, col) of the lattice that starts at
    (bin_x, bin_y) lists the blobs nearer than bin_margin, binned[bins[row, col]:bins[row, col+1]].
    """

    kind: int
    rows: int
    cols: int
    pitch: float
    first_dark: int
    dot_radius: float
    dark: float
    light: float
    margin: float
    strays: NDArray[np.float32]
    stray_x: float
    stray_y: float
    stray_per: float
    stray_slope: float
    blobs: NDArray[np.float64]
    blob_grey: NDArray[np.float64]
    bins: NDArray[np.int64]
    binned: NDArray[np.int64]
    bin_x: float
    bin_y: float
    bin_per: float
    bin_margin: float


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _stray(ink: InkArrays, x: float, y: float) -> Any:
    """Where on a flawless print the ink of point (x, y) would be."""
    rows, cols = ink.strays.shape[0], ink.strays.shape[1]
    u = min(max((x - ink.stray_x) * ink.stray_per, 0.0), cols - 1.0)
    v = min(max((y - ink.stray_y) * ink.stray_per, 0.0), rows - 1.0)
    col, row = min(int(u), cols - 2), min(int(v), rows - 2)
    u, v = u - col, v - row
    # Smooth steps: the print's edges have no kinks at the lattice's lines.
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    s = ink.strays
    ax = s[row, col, 0] * (1 - u) + s[row, col + 1, 0] * u
    bx = s[row + 1, col, 0] * (1 - u) + s[row + 1, col + 1, 0] * u
    ay = s[row, col, 1] * (1 - u) + s[row, col + 1, 1] * u
    by = s[row + 1, col, 1] * (1 - u) + s[row + 1, col + 1, 1] * u
    return x + ax * (1 - v) + bx * v, y + ay * (1 - v) + by * v


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _checkers(ink: InkArrays, x: float, y: float) -> Any:
    u = x / ink.pitch + (ink.cols + 1) / 2
    v = y / ink.pitch + (ink.rows + 1) / 2
    if u < 0 or v < 0 or u >= ink.cols + 1 or v >= ink.rows + 1:
        du = max(-u, u - (ink.cols + 1), 0.0)
        dv = max(-v, v - (ink.rows + 1), 0.0)
        return ink.margin, max(du, dv) * ink.pitch
    col, row = int(u), int(v)
    near = min(u - col, col + 1 - u, v - row, row + 1 - v)
    dark = (row + col + ink.first_dark) % 2 == 1
    return ink.dark if dark else ink.light, near * ink.pitch


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _dots(ink: InkArrays, x: float, y: float) -> Any:
    u = x / ink.pitch + (ink.cols - 1) / 2
    v = y / ink.pitch + (ink.rows - 1) / 2
    du = u - min(max(np.floor(u + 0.5), 0.0), ink.cols - 1.0)
    dv = v - min(max(np.floor(v + 0.5), 0.0), ink.rows - 1.0)
    beyond = np.sqrt(du * du + dv * dv) * ink.pitch - ink.dot_radius
    return ink.dark if beyond < 0 else ink.margin, abs(beyond)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def ink_at(ink: InkArrays, x: float, y: float) -> Any:
    """Grey at material point (x, y), and a distance (m) within which it does not change."""
    px, py = x, y
    if ink.strays.size:
        px, py = _stray(ink, x, y)
    grey, clear = _checkers(ink, px, py) if ink.kind == CHECKERS else _dots(ink, px, py)
    clear /= 1 + ink.stray_slope
    if ink.binned.size == 0:
        return grey, clear
    clear = min(clear, ink.bin_margin)
    col = int(np.floor((x - ink.bin_x) * ink.bin_per))
    row = int(np.floor((y - ink.bin_y) * ink.bin_per))
    if row < 0 or col < 0 or row >= ink.bins.shape[0] or col >= ink.bins.shape[1] - 1:
        return grey, clear
    for k in range(ink.bins[row, col], ink.bins[row, col + 1]):
        blob = ink.blobs[ink.binned[k]]
        dx, dy = x - blob[0], y - blob[1]
        a, b = blob[2] * dx + blob[3] * dy, blob[4] * dx + blob[5] * dy
        share = np.sqrt(a * a + b * b)
        clear = min(clear, abs(share - 1) * blob[6])
        if share < 1:
            grey = ink.blob_grey[ink.binned[k]]
    return grey, clear


@njit(cache=True, nogil=True, error_model="numpy")
def ink_on(ink: InkArrays, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Greys (n,) at material points (n, 2) m."""
    grey = np.empty(len(xy))
    for k in range(len(xy)):
        grey[k] = ink_at(ink, xy[k, 0], xy[k, 1])[0]
    return grey
