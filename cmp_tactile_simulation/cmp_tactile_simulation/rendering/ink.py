"""Printed patterns: the grey of the skin as a function of material coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.sensor.dot_code import DOT_DIAMETER
from cmp_tactile_processing.sensor.parameters import Parameters, parameter
from cmp_tactile_processing.sensor.parts import Pattern
from cmp_tactile_simulation.rendering import Purpose, random_stream

# Flaws of a printed pattern, as fixed functions of the place on the skin.

# A lattice point of the strays lies within so many standard deviations.
LARGEST_DEVIATION = 2.5
# Mean over a cell of what smooth steps between independent points leave of their variance.
KEPT_VARIANCE = (26 / 35) ** 2
MAX_LATTICE = 4000
# Longer over shorter half-axis of a blob, at most.
LONGEST_BLOB = 1.6
# Bins beyond the print: a blob at its rim reaches there, and what is beyond them is in the last.
AROUND = 3

# Greys of the noise-free frame; the camera settings say what a camera makes of them.
DARK_GREY, LIGHT_GREY, HOUSING_GREY = 45.0, 205.0, 18.0
PATTERN_TYPES = ("cmp", "dmp")

CHECKERS, DOTS = 0, 1


@dataclass(frozen=True)
class PrintDefects(Parameters, section="print"):
    """What is wrong with the print; the places are set by the seed.

    Raises InputError for a value outside its range.
    """

    missing_ink: int = parameter(0, "number of blobs without ink on the pattern", within=(0, 10000))
    splashes: int = parameter(0, "number of blobs of ink on the pattern", within=(0, 10000))
    blob_radius: float = parameter(
        8e-5,
        "mean radius of a blob; each is half to one and a half times as large",
        unit="m",
        within=(1e-6, 5e-3),
    )
    ragged_edge: float = parameter(
        0.0,
        "standard deviation of the printed edges from straight lines",
        unit="m",
        within=(0, 2e-4),
    )
    ragged_length: float = parameter(
        5e-5, "correlation length of the ragged edges", unit="m", within=(1e-5, 5e-3)
    )


@dataclass(frozen=True)
class Strays:
    """Straying of the print: values (h, w, 2) m on a lattice from (x, y) m, `per` points a m.

    slope: its largest change over a distance, per that distance.  most: twice its largest amount.
    """

    values: NDArray[np.float32] | None = None
    x: float = 0.0
    y: float = 0.0
    per: float = 0.0
    slope: float = 0.0
    most: float = 0.0


@dataclass(frozen=True)
class Blobs:
    """Elliptic blobs in bins: bins (h, w, k, 8) from (x, y) m, `per` to a m; see InkArrays.

    A bin lists the blobs that come nearer to it than `margin`, m.
    """

    bins: NDArray[np.float64]
    x: float
    y: float
    per: float
    margin: float


def stray_lattice(
    defects: PrintDefects, size: tuple[float, float], rng: np.random.Generator
) -> Strays:
    """Straying over a print of that size (x, y) m.

    Raises InputError where the print is too large for so small a length.
    """
    if defects.ragged_edge == 0:
        return Strays()
    length = defects.ragged_length
    reach = LARGEST_DEVIATION * defects.ragged_edge
    cols, rows = (math.ceil((side + 2 * reach) / length) + 1 for side in size)
    if max(rows, cols) > MAX_LATTICE:
        least = max(size) / MAX_LATTICE
        msg = f"print.ragged_length: found {length:g}, expected at least {least:.2g} m here"
        raise InputError(msg)
    noise = rng.standard_normal((rows, cols, 2)).clip(-LARGEST_DEVIATION, LARGEST_DEVIATION)
    values = noise * (defects.ragged_edge / math.sqrt(KEPT_VARIANCE))
    steps = [np.linalg.norm(np.diff(values, axis=axis), axis=-1).max() for axis in (0, 1)]
    # A smooth step is 1.5 times as steep at its middle as on average.
    slope = 1.5 * float(np.hypot(*steps)) / length
    x, y = -(cols - 1) * length / 2, -(rows - 1) * length / 2
    most = 2 * float(np.linalg.norm(values, axis=-1).max())
    return Strays(values.astype(np.float32), x, y, 1 / length, slope, most)


def scattered_blobs(
    defects: PrintDefects,
    size: tuple[float, float],
    greys: tuple[float, float],
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Blobs without ink, then splashes, of these greys, anywhere on a print of size (x, y) m.

    (n, 8), columns as those of `InkArrays.blobs`.
    """
    count = defects.missing_ink + defects.splashes
    centre = rng.uniform(-0.5, 0.5, (count, 2)) * size
    radius = defects.blob_radius * rng.uniform(0.5, 1.5, count)
    stretch = np.sqrt(rng.uniform(1, LONGEST_BLOB, count))
    angle = rng.uniform(0, np.pi, count)
    cosine, sine = np.cos(angle), np.sin(angle)
    along, across = 1 / (radius * stretch), stretch / radius
    columns = [centre[:, 0], centre[:, 1]]
    columns += [cosine * along, sine * along, -sine * across, cosine * across, radius / stretch]
    columns.append(np.repeat(greys, [defects.missing_ink, defects.splashes]))
    return np.stack(columns, axis=1)


def code_blobs(pattern: Pattern) -> NDArray[np.float64]:
    """The dots of a pattern's code as round blobs (n, 8), each of the other checkers' grey."""
    dots = pattern.dots()
    centre = pattern.checker_middles()[dots]
    radius = DOT_DIAMETER * pattern.pitch / 2
    matrix = np.broadcast_to(np.eye(2).ravel() / radius, (len(centre), 4))
    grey = np.where(pattern.dark_checkers()[dots], LIGHT_GREY, DARK_GREY)
    return np.column_stack([centre, matrix, np.full(len(centre), radius), grey])


def bin_blobs(blobs: NDArray[np.float64], size: tuple[float, float], largest: float) -> Blobs:
    """Blobs (n, 8) on a print of size (x, y) m in bins; largest: usual radius of such, m."""
    side = max(2 * largest, max(size) / 60)
    x, y = -size[0] / 2 - AROUND * side, -size[1] / 2 - AROUND * side
    cols, rows = (math.ceil(extent / side) + 2 * AROUND for extent in size)
    middle_x = x + side * (np.arange(cols) + 0.5)
    middle_y = y + side * (np.arange(rows) + 0.5)
    # The margin is one side of a bin, from any point of it.
    longer = 1 / np.hypot(blobs[:, 2], blobs[:, 3])
    reach = longer + 1.5 * side
    near_x = np.abs(middle_x[:, None] - blobs[:, 0]) <= reach
    near_y = np.abs(middle_y[:, None] - blobs[:, 1]) <= reach
    bins = _binned(blobs, near_y, near_x)
    return Blobs(bins, x, y, 1 / side, side)


def _binned(
    blobs: NDArray[np.float64], near_y: NDArray[np.bool_], near_x: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Bins (h, w, k, 8) of blobs (n, 8); near_y (h, n), near_x (w, n): those that reach it."""
    listed = near_y[:, None] & near_x[None]
    bins = np.full((*listed.shape[:2], max(int(listed.sum(axis=2).max()), 1), 8), np.nan)
    for row, col in np.argwhere(listed.any(axis=2)):
        own = blobs[listed[row, col]]
        bins[row, col, : len(own)] = own
    return bins


# The patterns.


@dataclass(frozen=True)
class Checkerboard:
    """Continuous marker pattern: (rows + 1) x (cols + 1) checkers with their inner corners.

    Where the pattern has a code, its dots are in the middles of checkers.
    margin: grey of the skin around the checkers.  Print defects are set by the seed.
    """

    pattern: Pattern
    defects: PrintDefects = field(default_factory=PrintDefects)
    seed: int = 0
    margin: float = LIGHT_GREY

    @cached_property
    def arrays(self) -> InkArrays:
        """What the renderer's compiled code reads."""
        return _arrays(self.pattern, CHECKERS, self.margin, (self.defects, self.seed))

    def grey(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Greys (...) at material points (..., 2) m, the gel frame's x and y at rest."""
        return _grey(self.arrays, xy)


@dataclass(frozen=True)
class Dots:
    """Discrete marker pattern: a dark dot at each of the rows x cols places of the corners.

    diameter: of a dot, as a share of the pitch.  Print defects are set by the seed.
    """

    pattern: Pattern
    defects: PrintDefects = field(default_factory=PrintDefects)
    seed: int = 0
    diameter: float = 0.5

    @cached_property
    def arrays(self) -> InkArrays:
        """What the renderer's compiled code reads."""
        arrays = _arrays(self.pattern, DOTS, LIGHT_GREY, (self.defects, self.seed))
        radius = self.diameter * self.pattern.pitch / 2
        return arrays._replace(plain=arrays.plain._replace(dot_radius=radius))

    def grey(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Greys (...) at material points (..., 2) m, the gel frame's x and y at rest."""
        return _grey(self.arrays, xy)


def ink_of(
    pattern: Pattern, pattern_type: str, defects: PrintDefects | None = None, seed: int = 0
) -> Checkerboard | Dots:
    """The print of that type: "cmp" checkers or "dmp" dots; InputError for another."""
    defects = defects or PrintDefects()
    if pattern_type == "cmp":
        return Checkerboard(pattern, defects, seed)
    if pattern_type == "dmp":
        return Dots(pattern, defects, seed)
    msg = f"pattern_type: found {pattern_type!r}, expected one of {', '.join(PATTERN_TYPES)}"
    raise InputError(msg)


def _grey(arrays: InkArrays, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    flat = np.ascontiguousarray(xy, dtype=np.float64).reshape(-1, 2)
    return np.asarray(ink_on(arrays, flat)).reshape(np.shape(xy)[:-1])


def _arrays(
    pattern: Pattern, kind: int, margin: float, print_flaws: tuple[PrintDefects, int]
) -> InkArrays:
    defects, seed = print_flaws
    size = (pattern.cols + 1) * pattern.pitch, (pattern.rows + 1) * pattern.pitch
    # Apart, so that more blobs leave the edges as they are.
    edge_rng, blob_rng = (
        random_stream(purpose, seed) for purpose in (Purpose.PRINT_EDGES, Purpose.PRINT_BLOBS)
    )
    plain = Print(
        kind=kind,
        rows=pattern.rows,
        cols=pattern.cols,
        pitch=float(pattern.pitch),
        first_dark=int(pattern.corner_checker == "dark"),
        dot_radius=0.0,
        dark=DARK_GREY,
        light=LIGHT_GREY,
        margin=float(margin),
    )
    code = code_blobs(pattern) if kind == CHECKERS else np.empty((0, 8))
    if not (defects.missing_ink or defects.splashes or defects.ragged_edge or len(code)):
        return InkArrays(plain, None, None)
    strays = stray_lattice(defects, size, edge_rng)
    flaws = scattered_blobs(defects, size, (LIGHT_GREY, DARK_GREY), blob_rng)
    blobs = bin_blobs(np.concatenate([code, flaws]), size, defects.blob_radius)
    flawed = plain._replace(
        stray_x=strays.x,
        stray_y=strays.y,
        stray_per=strays.per,
        stray_slope=strays.slope,
        stray_most=strays.most,
        bin_x=blobs.x,
        bin_y=blobs.y,
        bin_per=blobs.per,
        bin_margin=blobs.margin,
    )
    return InkArrays(flawed, strays.values, blobs.bins)


# The grey of the print at a material point, as compiled code evaluates it.


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
    shorter half-axis; grey, which is NaN where no more follow.  None where there are none.
    """

    plain: Print
    strays: NDArray[np.float32] | None
    blobs: NDArray[np.float64] | None


@kernel_part(forceinline=True)
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


@kernel(forceinline=True)
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


@kernel_part(forceinline=True)
def _dots(ink: Print, x: float, y: float) -> Any:
    u = x / ink.pitch + (ink.cols - 1) / 2
    v = y / ink.pitch + (ink.rows - 1) / 2
    du = u - min(max(np.floor(u + 0.5), 0.0), ink.cols - 1.0)
    dv = v - min(max(np.floor(v + 0.5), 0.0), ink.rows - 1.0)
    beyond = np.sqrt(du * du + dv * dv) * ink.pitch - ink.dot_radius
    grey, other = (ink.dark, ink.margin) if beyond < 0 else (ink.margin, ink.dark)
    return grey, abs(beyond), other


@kernel_part(forceinline=True)
def _flawless(ink: Print, x: float, y: float) -> Any:
    return _checkers(ink, x, y) if ink.kind == CHECKERS else _dots(ink, x, y)


@kernel_part(forceinline=True)
def _bin(ink: Print, blobs: NDArray[np.float64], x: float, y: float) -> tuple[int, int]:
    """Row and column of a point's bin, or of the nearest."""
    col = int(min(max((x - ink.bin_x) * ink.bin_per, 0.0), blobs.shape[1] - 1.0))
    row = int(min(max((y - ink.bin_y) * ink.bin_per, 0.0), blobs.shape[0] - 1.0))
    return row, col


@kernel_part(forceinline=True)
def _blotted(ink: Print, blobs: NDArray[np.float64], xy: tuple[float, float], flawless: Any) -> Any:
    """What blobs make of grey, clear distance, other grey and its distance at a point."""
    grey, clear, other, near = flawless
    clear = min(clear, ink.bin_margin)
    (x, y), (row, col) = xy, _bin(ink, blobs, xy[0], xy[1])
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


@kernel_part(forceinline=True)
def is_blotted(
    ink: Print, blobs: NDArray[np.float64] | None, circle: tuple[float, float, float]
) -> bool:
    """Whether blobs may reach into a circle (x, y, radius) on the skin."""
    if blobs is None:
        return False
    row, col = _bin(ink, blobs, circle[0], circle[1])
    return not (np.isnan(blobs[row, col, 0, 7]) and circle[2] < ink.bin_margin)


@kernel_part(forceinline=True)
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
    px, py = (x, y) if strays is None else _stray(ink, strays, x, y)
    grey, near, other = _flawless(ink, px, py)
    clear = max(near / (1 + ink.stray_slope), near - ink.stray_most)
    if blobs is not None:
        grey, clear, other, near = _blotted(ink, blobs, (x, y), (grey, clear, other, near))
    beyond = max(abs(x) - ink.half_x, abs(y) - ink.half_y)
    if beyond > 0:
        grey, clear, other, near = ink.housing, beyond, ink.margin, beyond
    elif -beyond < near:
        clear, other, near = min(clear, -beyond), ink.housing, -beyond
    return grey, clear, other, near


@kernel
def ink_on(ink: InkArrays, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Greys (n,) at material points (n, 2) m."""
    plain, strays, blobs = ink
    grey = np.empty(len(xy))
    for k in range(len(xy)):
        grey[k] = ink_at(plain, strays, blobs, xy[k, 0], xy[k, 1])[0]
    return grey
