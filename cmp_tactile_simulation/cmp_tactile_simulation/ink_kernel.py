"""The grey of the print at a material point, as compiled code evaluates it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["CHECKERS", "DOTS", "Flaws", "InkArrays", "Print", "ink_at", "ink_on"]

CHECKERS, DOTS = 0, 1


class Print(NamedTuple):
    """A flawless print and where it ends; lengths in m, greys as the renderer gives them.

    kind: CHECKERS or DOTS.  first_dark: 1 where the checker outside corner (0, 0) is dark.
    half_x, half_y: where the skin ends.  housing: grey beyond.
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
    half_x: float = np.inf
    half_y: float = np.inf
    housing: float = 0.0


class Flaws(NamedTuple):
    """Flaws of a print; lengths in m.

    strays (h, w, 2) float32: by how much the print strays, on a lattice that starts at
    (stray_x, stray_y) with stray_per points a metre; empty for none.  stray_slope: its largest
    change over a distance, per that distance.
    blobs (k, 7): centre x, y; matrix that maps the blob to the unit circle, row by row; shorter
    half-axis.  blob_grey (k,).  bins (h, w + 1): bin (row, col) of the lattice that starts at
    (bin_x, bin_y) lists the blobs nearer than bin_margin, binned[bins[row, col]:bins[row, col+1]].
    """

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


class InkArrays(NamedTuple):
    """What `ink_at` reads; flaws is None where there are none."""

    plain: Print
    flaws: Flaws | None


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _stray(ink: Flaws, x: float, y: float) -> Any:
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
def _checkers(ink: Print, x: float, y: float) -> Any:
    u = x / ink.pitch + (ink.cols + 1) / 2
    v = y / ink.pitch + (ink.rows + 1) / 2
    # The checker, or the nearest one.
    col = int(min(max(u, 0.0), float(ink.cols)))
    row = int(min(max(v, 0.0), float(ink.rows)))
    dark = (row + col + ink.first_dark) % 2 == 1
    grey, other = (ink.dark, ink.light) if dark else (ink.light, ink.dark)
    left, above = u - col, v - row
    near = min(left, 1 - left, above, 1 - above)
    outside = (col == 0 and left == near) or (col == ink.cols and 1 - left == near)
    outside |= (row == 0 and above == near) or (row == ink.rows and 1 - above == near)
    if near < 0:
        # Beside the print: to its side or its corner.
        right, down = max(-left, left - 1, 0.0), max(-above, above - 1, 0.0)
        near = np.sqrt(right * right + down * down)
        grey, other = ink.margin, grey
    elif outside:
        other = ink.margin
    return grey, near * ink.pitch, other


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _dots(ink: Print, x: float, y: float) -> Any:
    u = x / ink.pitch + (ink.cols - 1) / 2
    v = y / ink.pitch + (ink.rows - 1) / 2
    du = u - min(max(np.floor(u + 0.5), 0.0), ink.cols - 1.0)
    dv = v - min(max(np.floor(v + 0.5), 0.0), ink.rows - 1.0)
    beyond = np.sqrt(du * du + dv * dv) * ink.pitch - ink.dot_radius
    grey, other = (ink.dark, ink.margin) if beyond < 0 else (ink.margin, ink.dark)
    return grey, abs(beyond), other


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _blotted(ink: Flaws, x: float, y: float, flawless: Any) -> Any:
    """What blobs make of grey, clear distance and other grey at a point."""
    grey, clear, other = flawless
    if clear > ink.bin_margin:
        clear, other = ink.bin_margin, grey
    col = int(np.floor((x - ink.bin_x) * ink.bin_per))
    row = int(np.floor((y - ink.bin_y) * ink.bin_per))
    if 0 <= row < ink.bins.shape[0] and 0 <= col < ink.bins.shape[1] - 1:
        for k in range(ink.bins[row, col], ink.bins[row, col + 1]):
            number = ink.binned[k]
            dx, dy = x - ink.blobs[number, 0], y - ink.blobs[number, 1]
            a = ink.blobs[number, 2] * dx + ink.blobs[number, 3] * dy
            b = ink.blobs[number, 4] * dx + ink.blobs[number, 5] * dy
            share = np.sqrt(a * a + b * b)
            near = abs(share - 1) * ink.blobs[number, 6]
            if near < clear:
                clear, other = near, grey if share < 1 else ink.blob_grey[number]
            if share < 1:
                grey = ink.blob_grey[number]
    return grey, clear, other


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _flawless(ink: Print, x: float, y: float) -> Any:
    return _checkers(ink, x, y) if ink.kind == CHECKERS else _dots(ink, x, y)


@njit(cache=True, nogil=True, error_model="numpy")
def _flawed(ink: Print, flaws: Flaws, x: float, y: float) -> Any:
    px, py = x, y
    if flaws.strays.size:
        px, py = _stray(flaws, x, y)
    grey, clear, other = _flawless(ink, px, py)
    return _blotted(flaws, x, y, (grey, clear / (1 + flaws.stray_slope), other))


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def ink_at(ink: Print, flaws: Flaws | None, x: float, y: float) -> Any:
    """Grey at material point (x, y), a distance (m) within which it does not change, and the
    grey beyond the nearest change.
    """
    # Decided while compiling: a call that hands on arrays costs more than all the rest.
    if flaws is None:
        grey, clear, other = _flawless(ink, x, y)
    else:
        grey, clear, other = _flawed(ink, flaws, x, y)
    beyond = max(abs(x) - ink.half_x, abs(y) - ink.half_y)
    if beyond > 0:
        grey, clear, other = ink.housing, beyond, ink.margin
    elif -beyond < clear:
        clear, other = -beyond, ink.housing
    return grey, clear, other


@njit(cache=True, nogil=True, error_model="numpy")
def ink_on(ink: InkArrays, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Greys (n,) at material points (n, 2) m."""
    plain, flaws = ink
    grey = np.empty(len(xy))
    for k in range(len(xy)):
        grey[k] = ink_at(plain, flaws, xy[k, 0], xy[k, 1])[0]
    return grey
