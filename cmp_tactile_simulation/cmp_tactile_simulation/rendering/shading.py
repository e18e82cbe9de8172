"""From guesses of the material point behind each pixel to the pixel's grey.

First the pixels near a change of grey get their material point exactly; then each pixel is the
mean of its samples; their material points come from the quadratic through the pixel and its eight
neighbours, or, where the surface folds or bends sharply, from a ray of their own.  A sample is a
small square: what lies beyond the nearest change of grey counts in proportion.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_simulation.rendering.ink import InkArrays, Print, ink_at
from cmp_tactile_simulation.rendering.surface import SplineSurface, first_meeting, meet

# What is known of a pixel's material point.
EMPTY, ROUGH, EXACT = 0, 1, 2
# A pixel this many of its sizes from a change of grey needs no exact point: a pixel that the
# change crosses uses those one diagonal around it.
CLEAR_SIZES = 2.8
# Second differences of material points over the first, above which a quadratic will not do ...
BENT = 0.05
# ... and above which neighbours lie on different parts of the surface.
TORN = 0.5
# Mesh pixels this far beyond the block, in pixels, touch no pixel of it.
WELL_BEYOND = 1.6
# Guesses this near to each other, in pixels, lead to the same meeting.
ALIKE_PIXELS = 2.0
# Pixels of one grey, of a smooth part of the surface, and of a folded or sharply bent one.
ONE_GREY, SMOOTH, BROKEN = 0, 1, 2


class Picture(NamedTuple):
    """One view in the making; arrays are one pixel larger all around than the view.

    Pixel (v, u) of the view has entry [v + 1, u + 1], in the middle of [v : v + 3, u : u + 3].

    points (h + 2, w + 2, 4): as `rasterize` gives them.  state (h + 2, w + 2): EMPTY, ROUGH
    (a guess) or EXACT.  origins, directions: of `pixel_rays`.  pixel_m: a pixel's size on the
    surface, m.  samples: along each side of a pixel.  fineness: greys wanted along it.
    """

    points: NDArray[np.float64]
    state: NDArray[np.uint8]
    origins: NDArray[np.float64]
    directions: NDArray[np.float64]
    pixel_m: float
    samples: int
    fineness: int


@kernel_part(forceinline=True)
def _mixed(
    ink: Print,
    strays: NDArray[np.float32] | None,
    blobs: NDArray[np.float64] | None,
    xy: tuple[float, float],
    side: float,
) -> Any:
    """Mean grey of a sample that is a square of that side (m), about a material point."""
    grey, _, other, near = ink_at(ink, strays, blobs, xy[0], xy[1])
    # How much of a square lies beyond a straight line: right for its mean and its spread.
    return grey + (other - grey) * max(0.5 - near / side, 0.0)


@kernel_part(forceinline=True)
def _spread(p: NDArray[np.float64], v: int, u: int) -> Any:
    """First differences of material points across a pixel, and the largest second difference."""
    ux, uy = (p[v + 1, u + 2, 0] - p[v + 1, u, 0]) / 2, (p[v + 1, u + 2, 1] - p[v + 1, u, 1]) / 2
    vx, vy = (p[v + 2, u + 1, 0] - p[v, u + 1, 0]) / 2, (p[v + 2, u + 1, 1] - p[v, u + 1, 1]) / 2
    bend = 0.0
    for c in range(2):
        uu = p[v + 1, u + 2, c] + p[v + 1, u, c] - 2 * p[v + 1, u + 1, c]
        vv = p[v + 2, u + 1, c] + p[v, u + 1, c] - 2 * p[v + 1, u + 1, c]
        falling = p[v + 2, u + 2, c] + p[v, u, c] - 2 * p[v + 1, u + 1, c]
        rising = p[v + 2, u, c] + p[v, u + 2, c] - 2 * p[v + 1, u + 1, c]
        bend = max(bend, abs(uu), abs(vv), abs(falling), abs(rising))
    return ux, uy, vx, vy, bend


@kernel_part(forceinline=True)
def _ray(field: NDArray[np.float64], v: int, u: int) -> Any:
    """Entry of a field of rays that may be the same for all pixels."""
    return field[min(v, field.shape[0] - 1), min(u, field.shape[1] - 1)]


@kernel
def solve(surface: SplineSurface, ink: InkArrays, picture: Picture, rows: tuple[int, int]) -> None:
    """Make the material points of these rows exact where the greys depend on them.

    rows: first and last + 1 of the arrays.  Reads the guesses of its own pixels alone.
    """
    p, state, (plain, strays, blobs) = picture.points, picture.state, ink
    for v in range(rows[0], rows[1]):
        for u in range(p.shape[1]):
            x, y = p[v, u, 0], p[v, u, 1]
            if np.isnan(x):
                state[v, u] = EMPTY
                continue
            state[v, u] = ROUGH
            _, clear, _, _ = ink_at(plain, strays, blobs, x, y)
            if clear > CLEAR_SIZES * p[v, u, 3]:
                continue
            origin, direction = _ray(picture.origins, v, u), picture.directions[v, u]
            good, x, y, _ = meet(surface, origin, direction, x, y)
            if good:
                p[v, u, 0], p[v, u, 1], state[v, u] = x, y, EXACT


@kernel(forceinline=True)
def _quadratic(
    p: NDArray[np.float64], pixel: tuple[int, int], c: int, right: float, down: float
) -> Any:
    """Component c of a field, (right, down) px from the centre of a pixel."""
    v, u = pixel
    if p.shape[0] == 1:
        # All rays have the same origin.
        return p[0, 0, c]
    east, west, south, north = (
        p[v + 1, u + 2, c],
        p[v + 1, u, c],
        p[v + 2, u + 1, c],
        p[v, u + 1, c],
    )
    twist = p[v + 2, u + 2, c] - p[v + 2, u, c] - p[v, u + 2, c] + p[v, u, c]
    return (
        p[v + 1, u + 1, c]
        + right * ((east - west) / 2 + right * ((east + west) / 2 - p[v + 1, u + 1, c]))
        + down * ((south - north) / 2 + down * ((south + north) / 2 - p[v + 1, u + 1, c]))
        + right * down * twist / 4
    )


@kernel_part(forceinline=True)
def _smooth(
    ink: InkArrays, p: NDArray[np.float64], count: int, pixel: tuple[int, int], out: Any
) -> None:
    """Greys within a pixel on an unbroken part of the surface."""
    v, u = pixel
    plain, strays, blobs = ink
    per_part = count // out.shape[0]
    # The quadratics' coefficients, once for all samples.
    x0, y0 = p[v + 1, u + 1, 0], p[v + 1, u + 1, 1]
    xr, yr, xd, yd, _ = _spread(p, v, u)
    side = np.sqrt((xr * xr + yr * yr + xd * xd + yd * yd) / 2) / count
    xrr = (p[v + 1, u + 2, 0] + p[v + 1, u, 0]) / 2 - x0
    yrr = (p[v + 1, u + 2, 1] + p[v + 1, u, 1]) / 2 - y0
    xdd = (p[v + 2, u + 1, 0] + p[v, u + 1, 0]) / 2 - x0
    ydd = (p[v + 2, u + 1, 1] + p[v, u + 1, 1]) / 2 - y0
    xrd = (p[v + 2, u + 2, 0] - p[v + 2, u, 0] - p[v, u + 2, 0] + p[v, u, 0]) / 4
    yrd = (p[v + 2, u + 2, 1] - p[v + 2, u, 1] - p[v, u + 2, 1] + p[v, u, 1]) / 4
    for k in range(count):
        down = (k + 0.5) / count - 0.5
        for j in range(count):
            right = (j + 0.5) / count - 0.5
            x = x0 + right * (xr + right * xrr + down * xrd) + down * (xd + down * xdd)
            y = y0 + right * (yr + right * yrr + down * yrd) + down * (yd + down * ydd)
            out[k // per_part, j // per_part] += _mixed(plain, strays, blobs, (x, y), side) / (
                per_part * per_part
            )


@kernel_part
def _cast(
    surface: SplineSurface,
    ink: InkArrays,
    picture: Picture,
    pixel: tuple[int, int],
    out: Any,
) -> None:
    """Greys within a pixel by a ray for each sample, where the surface folds or bends sharply."""
    v, u = pixel
    plain, strays, blobs = ink
    count = picture.samples
    per_part = count // picture.fineness
    starts, alike = _starts(picture, v, u), ALIKE_PIXELS * picture.pixel_m
    side = picture.pixel_m / count
    origin, direction = np.empty(3), np.empty(3)
    for k in range(count * count):
        right = (k % count + 0.5) / count - 0.5
        down = (k // count + 0.5) / count - 0.5
        for c in range(3):
            origin[c] = _quadratic(picture.origins, pixel, c, right, down)
            direction[c] = _quadratic(picture.directions, pixel, c, right, down)
        found, x, y, _ = first_meeting(surface, origin, direction, starts, alike)
        grey = plain.housing
        if found:
            grey = _mixed(plain, strays, blobs, (x, y), side)
        out[k // count // per_part, k % count // per_part] += grey / (per_part * per_part)


@kernel_part
def _starts(picture: Picture, v: int, u: int) -> NDArray[np.float64]:
    """Guesses (9, 2) m for a pixel: the material points in and around it."""
    starts = np.empty((9, 2))
    for k in range(9):
        # The pixel itself first.
        row, col = v + (k // 3 + 1) % 3, u + (k + 1) % 3
        starts[k, 0], starts[k, 1] = picture.points[row, col, 0], picture.points[row, col, 1]
    return starts


@kernel_part
def _amid(p: NDArray[np.float64], state: NDArray[np.uint8], amid: NDArray[np.bool_]) -> None:
    """Mark those pixels of a row that `solve` found far from any change and that are about as
    large as was taken there; p (3, w + 2, 4), state (3, w + 2), amid (w,).

    A loop without branches, so that the compiler does several pixels at once.
    """
    for u in range(len(amid)):
        x, y = p[1, u + 1, 0], p[1, u + 1, 1]
        # A quarter of these differences is more than from the pixel's centre to its corner; NaN
        # beside an empty pixel.
        sides = abs(p[1, u + 2, 0] - x) + abs(p[1, u + 2, 1] - y)
        sides += abs(p[1, u, 0] - x) + abs(p[1, u, 1] - y)
        sides += abs(p[2, u + 1, 0] - x) + abs(p[2, u + 1, 1] - y)
        sides += abs(p[0, u + 1, 0] - x) + abs(p[0, u + 1, 1] - y)
        amid[u] = (state[1, u + 1] == ROUGH) & (sides / 4 < (CLEAR_SIZES - 0.5) * p[1, u + 1, 3])


@kernel_part(forceinline=True)
def _kind(
    p: NDArray[np.float64],
    state: NDArray[np.uint8],
    pixel_m: float,
    pixel: tuple[int, int],
    clear: float,
) -> int:
    """What is to be done about a pixel if the grey stays the same so far around its centre, m."""
    v, u = pixel
    known, exact = 0, True
    for row in range(v, v + 3):
        for col in range(u, u + 3):
            known += state[row, col] != EMPTY
            exact &= state[row, col] == EXACT
    if known < 9:
        return BROKEN if known else ONE_GREY
    xr, yr, xd, yd, bend = _spread(p, v, u)
    across, down = np.sqrt(xr * xr + yr * yr), np.sqrt(xd * xd + yd * yd)
    side = max(across, down)
    if bend > TORN * side:
        return BROKEN
    # A guess may be off by a part of a pixel.
    reach = (across + down + bend) / 2 + (0.0 if exact else pixel_m / 2)
    if clear > reach:
        return ONE_GREY
    return SMOOTH if exact and bend <= BENT * side else BROKEN


@kernel_part
def _beside(ink: Print, picture: Picture, pixel: tuple[int, int]) -> bool:
    """Whether all that is known around a pixel is housing: the mesh ends beyond the block."""
    v, u = pixel
    for row in range(v, v + 3):
        for col in range(u, u + 3):
            x, y = picture.points[row, col, 0], picture.points[row, col, 1]
            beyond = max(abs(x) - ink.half_x, abs(y) - ink.half_y)
            # False where nothing is known, and beyond is NaN.
            if beyond < WELL_BEYOND * picture.pixel_m:
                return False
    return True


@kernel
def shade(
    surface: SplineSurface,
    ink: InkArrays,
    picture: Picture,
    rows: tuple[int, int],
    out: NDArray[np.float32],
) -> None:
    """Greys of these rows (first, last + 1) of the view; a pixel is fineness^2 entries of `out`.

    Pixels of one grey take nothing out of tuples: that would cost more than all the rest.
    """
    plain, strays, blobs = ink
    first, fine = rows[0], picture.fineness
    # Counted from the band's first row: numbers that cannot be negative are looked up faster.
    points, state = picture.points[first:], picture.state[first:]
    pixel_m, samples = picture.pixel_m, picture.samples
    amid = np.empty(points.shape[1] - 2, np.bool_)
    for v in range(rows[1] - first):
        _amid(points[v : v + 3], state[v : v + 3], amid)
        for u in range(len(amid)):
            grey, clear = plain.housing, 0.0
            if state[v + 1, u + 1] != EMPTY:
                grey, clear, _, _ = ink_at(
                    plain, strays, blobs, points[v + 1, u + 1, 0], points[v + 1, u + 1, 1]
                )
            kind = ONE_GREY if amid[u] else _kind(points, state, pixel_m, (v, u), clear)
            top, left = (first + v) * fine, u * fine
            if kind == ONE_GREY:
                for row in range(top, top + fine):
                    for col in range(left, left + fine):
                        out[row, col] = grey
                continue
            part = out[top : top + fine, left : left + fine]
            part[:] = 0.0
            if kind == SMOOTH:
                _smooth(ink, points, samples, (v, u), part)
            elif _beside(plain, picture, (first + v, u)):
                part[:] = plain.housing
            else:
                _cast(surface, ink, picture, (first + v, u), part)
