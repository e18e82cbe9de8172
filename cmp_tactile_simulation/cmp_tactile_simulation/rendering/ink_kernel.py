"""The grey of the print at a material point, as compiled code evaluates it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["CHECKERS", "DOTS", "InkArrays", "Print", "ink_at", "ink_on"]

CHECKERS, DOTS = 0, 1


class Print(NamedTuple):
    """A print and where it ends; lengths in m, greys as the renderer gives them.

    kind: CHECKERS or DOTS.  first_dark: 1 where the checker outside corner (0, 0) is dark.
    half_x, half_y: where the skin ends.  housing: grey beyond.
    stray_x, stray_y: first point of the lattice of strays, which has stray_per points a metre.
    stray_slope: largest change of the straying over a distance, per that distance.
    stray_most: twice its largest amount.
    bin_x, bin_y: where the bins of blobs begin, which are bin_per to a metre.  bin_margin: blobs
    nearer than this to a bin are listed there.
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
    stray_x: float = 0.0
    stray_y: float = 0.0
    stray_per: float = 0.0
    stray_slope: float = 0.0
    stray_most: float = 0.0
    bin_x: float = 0.0
    bin_y: float = 0.0
    bin_per: float = 0.0
    bin_margin: float = 0.0


class InkArrays(NamedTuple):
    """What `ink_at` reads.  The arrays are no part of `Print`: in a tuple they make it slow.

    strays (h, w, 2) float32 m: by how much the print strays, on a lattice.  blobs (h, w, k, 8):
    those of each bin: centre x, y; matrix that maps the blob to the unit circle, row by row;
    shorter half-axis; grey, which is NaN where no more follow.  Both are None without flaws.
    """

    plain: Print
    strays: NDArray[np.float32] | None
    blobs: NDArray[np.float64] | None


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _stray(ink: Print, strays: NDArray[np.float32], x: float, y: float) -> Any:
    """Where on a flawless print the ink of point (x, y) would be."""
    rows, cols = strays.shape[0], strays.shape[1]
    u = min(max((x - ink.stray_x) * ink.stray_per, 0.0), cols - 1.0)
    v = min(max((y - ink.stray_y) * ink.stray_per, 0.0), rows - 1.0)
    col, row = min(int(u), cols - 2), min(int(v), rows - 2)
    u, v = u - col, v - row
    # Smooth steps: the print's edges have no kinks at the lattice's lines.
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    ax = strays[row, col, 0] * (1 - u) + strays[row, col + 1, 0] * u
    bx = strays[row + 1, col, 0] * (1 - u) + strays[row + 1, col + 1, 0] * u
    ay = strays[row, col, 1] * (1 - u) + strays[row, col + 1, 1] * u
    by = strays[row + 1, col, 1] * (1 - u) + strays[row + 1, col + 1, 1] * u
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
def _flawless(ink: Print, x: float, y: float) -> Any:
    return _checkers(ink, x, y) if ink.kind == CHECKERS else _dots(ink, x, y)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _blotted(ink: Print, blobs: NDArray[np.float64], xy: tuple[float, float], flawless: Any) -> Any:
    """What blobs make of grey, clear distance, other grey and its distance at a point."""
    grey, clear, other, near = flawless
    clear = min(clear, ink.bin_margin)
    x, y = xy
    col = int(min(max((x - ink.bin_x) * ink.bin_per, 0.0), blobs.shape[1] - 1.0))
    row = int(min(max((y - ink.bin_y) * ink.bin_per, 0.0), blobs.shape[0] - 1.0))
    for k in range(blobs.shape[2]):
        own = blobs[row, col, k, 7]
        if np.isnan(own):
            break
        dx, dy = x - blobs[row, col, k, 0], y - blobs[row, col, k, 1]
        a = blobs[row, col, k, 2] * dx + blobs[row, col, k, 3] * dy
        b = blobs[row, col, k, 4] * dx + blobs[row, col, k, 5] * dy
        share = np.sqrt(a * a + b * b)
        off = abs(share - 1) * blobs[row, col, k, 6]
        clear = min(clear, off)
        if off < near:
            near, other = off, grey if share < 1 else own
        if share < 1:
            grey = own
    return grey, clear, other, near


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def ink_at(
    ink: Print,
    strays: NDArray[np.float32] | None,
    blobs: NDArray[np.float64] | None,
    x: float,
    y: float,
) -> Any:
    """Grey at material point (x, y); a distance (m) within which it does not change for sure; the
    grey beyond the nearest change, and about how far (m) that is.
    """
    if strays is None or blobs is None:
        grey, clear, other = _flawless(ink, x, y)
        near = clear
    else:
        px, py = _stray(ink, strays, x, y)
        grey, near, other = _flawless(ink, px, py)
        clear = max(near / (1 + ink.stray_slope), near - ink.stray_most)
        grey, clear, other, near = _blotted(ink, blobs, (x, y), (grey, clear, other, near))
    beyond = max(abs(x) - ink.half_x, abs(y) - ink.half_y)
    if beyond > 0:
        grey, clear, other, near = ink.housing, beyond, ink.margin, beyond
    elif -beyond < near:
        clear, other, near = min(clear, -beyond), ink.housing, -beyond
    return grey, clear, other, near


@njit(cache=True, nogil=True, error_model="numpy")
def ink_on(ink: InkArrays, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Greys (n,) at material points (n, 2) m."""
    plain, strays, blobs = ink
    grey = np.empty(len(xy))
    for k in range(len(xy)):
        grey[k] = ink_at(plain, strays, blobs, xy[k, 0], xy[k, 1])[0]
    return grey
