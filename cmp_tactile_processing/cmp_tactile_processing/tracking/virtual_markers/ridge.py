"""Where the grey gradient across a gridline peaks: measured in pixel columns along it.

A column runs along the image axis that is nearer to the gridline's normal; "across" is the
coordinate along the column, "along" the other one.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import NAN_SAFE, kernel, kernel_part

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MAX_COLUMNS = 24
# In a longer segment only every second column is measured: the smoothed image holds no more.
SUBSAMPLED_ABOVE_PX = 8.0
# Standard deviation of the Gaussian that smooths the gradient before its peak is taken, px at
# least.  Wide ones leave less noise where edges are blurred.
MIN_WINDOW_PX = 1.2
# In units of the blur; sqrt(5) would be best, with what the image was smoothed by.
WINDOW_PER_BLUR = 1.6
# Bends and the next gridline allow this share of the checker's side at most.
MAX_WINDOW_PER_SIDE = 0.17
REACH_PER_WINDOW = 2.7
PHASES = 16
# Variance of the central difference's box, px^2.
BOX = 1.0 / 3.0
# Nearer to a corner than this many standard deviations of the edge's blur nothing is measured.
NEAREST_CROSSING = 1.2
# How far off the crossing gridline's pull on the ridge is: share of it, and of its square, 1 / px.
PULL_ERROR, PULL_ERROR_SQUARE = 0.15, 0.7
# Standard deviation of the crossing gridline's slope at the corner.
CROSSING_ERROR = 0.01
# What is not modelled (sampling, light, print), px.
MODEL_ERROR = 0.012
# A gradient below this share of the median of all gridlines, or below this many standard
# deviations of its noise, is not an edge.
WEAKEST_GRADIENT, LEAST_SIGNAL = 0.12, 4.0
# How far from the curve through the corners a gridline may run, px and share of the segment.
SEARCH_PX, SEARCH_SHARE = 2.5, 0.25
# Of more segments than this every second one shows enough of blur and strength.
MANY_SEGMENTS = 128
PEAK_ROUNDS = 4
MAX_PEAK_STEP_PX = 1.5
CONVERGED_PEAK_STEP_PX = 0.3
# A column is left out where the crossing gridline flattens the peak to less than this share.
LEAST_PEAK = 0.3
STEPS_PER_UNIT = 64
FARTHEST_CROSSING = 4.0


class Pixels(NamedTuple):
    """A smoothed image: its pixels (height * width,), row by row."""

    grey: NDArray[np.float32]
    width: int
    height: int


class Edges(NamedTuple):
    """What the edges of a frame look like in the smoothed image.

    blur: variance of their blur, px^2; gradient: its median, grey / px; sign: of the gradient
    across the segment (0, 0), it alternates from there; noise: variance of a peak's place times
    squared gradient for an edge of blur 1; gradient_noise: standard deviation, grey / px; window,
    taps: of the Gaussian that the gradient is smoothed by, px, and its `window_taps`.
    """

    blur: float
    gradient: float
    sign: float
    noise: float
    gradient_noise: float
    window: float
    taps: Array


class Segments(NamedTuple):
    """The gridlines of one direction: a lines of b segments, s = i b + j.

    corners (a, b+1, 2) px; crossing (a, b+1, 2): tangents of the gridlines that cross; curve
    (a, b, 4, 2): cubics, see `fit_curves`; doubtful (a, b, n): markers not to be measured, n = 0
    for none.
    """

    corners: Array
    crossing: Array
    curve: Array
    doubtful: NDArray[np.bool_]


def window_of(blur: float, smoothing: float, side: float) -> float:
    """Window, px, for edges of that blur, px^2, of which smoothing by so many px made a part,
    between checkers of that side, px.
    """
    wanted = WINDOW_PER_BLUR**2 * (blur - smoothing**2) - smoothing**2 - BOX
    if not (wanted > MIN_WINDOW_PX**2 and side > 0):
        return MIN_WINDOW_PX
    # Steps, so that a few tables serve all frames.
    return max(MIN_WINDOW_PX, round(10 * min(math.sqrt(wanted), MAX_WINDOW_PER_SIDE * side)) / 10)


@lru_cache(maxsize=32)
def window_taps(window: float) -> Array:
    """Weights (PHASES + 1, taps, 3) of the pixels: smoothed gradient, its moments 1 and 2."""
    reach = round(REACH_PER_WINDOW * window) + 1
    taps = np.zeros((PHASES + 1, 2 * reach + 3, 3))
    offset = np.arange(-reach, reach + 1)
    for phase in range(PHASES + 1):
        distance = offset - (phase / PHASES - 0.5)
        weight = np.exp(-(distance**2) / (2 * window**2))
        for moment in range(3):
            # Weights of the central differences become weights of the pixels.
            part = weight / weight.sum() * distance**moment / 2
            taps[phase, 2:, moment] += part
            taps[phase, :-2, moment] -= part
    return taps


def _bell_table() -> Array:
    """Normal density phi(w) and 2 Phi(w) - 1 over w, (n, 2)."""
    w = (np.arange(int(FARTHEST_CROSSING * STEPS_PER_UNIT) + 2) + 0.5) / STEPS_PER_UNIT
    step = np.array([math.erf(x / math.sqrt(2)) for x in w])
    return np.stack([np.exp(-(w**2) / 2) / math.sqrt(2 * math.pi), step], axis=1)


NARROW_TAPS, BELL = window_taps(MIN_WINDOW_PX), _bell_table()


@kernel_part(forceinline=True)
def _turn(curve: Array, turned: Array) -> int:
    """Copy a segment's cubic with (along, across) for (x, y) or (y, x); returns along's axis.

    -1 for a segment that is not known.
    """
    x = curve[1, 0] + curve[2, 0] + curve[3, 0]
    y = curve[1, 1] + curve[2, 1] + curve[3, 1]
    if not (math.isfinite(x) and math.isfinite(y)):
        return -1
    axis = 1 if abs(y) > abs(x) else 0
    for power in range(4):
        turned[power, 0] = curve[power, axis]
        turned[power, 1] = curve[power, 1 - axis]
    return axis


@kernel_part(forceinline=True)
def _at(curve: Array, along: float, guess: float) -> tuple[float, float, float, float]:
    """Parameter, across, both speeds of a turned cubic where it passes `along`: a Newton step."""
    here = ((curve[3, 0] * guess + curve[2, 0]) * guess + curve[1, 0]) * guess + curve[0, 0]
    speed_along = (3 * curve[3, 0] * guess + 2 * curve[2, 0]) * guess + curve[1, 0]
    t = guess + (along - here) / speed_along
    across = ((curve[3, 1] * t + curve[2, 1]) * t + curve[1, 1]) * t + curve[0, 1]
    speed_along = (3 * curve[3, 0] * t + 2 * curve[2, 0]) * t + curve[1, 0]
    speed_across = (3 * curve[3, 1] * t + 2 * curve[2, 1]) * t + curve[1, 1]
    return t, across, speed_along, speed_across


@kernel_part(fastmath=True, forceinline=True)
def _moments(grey: NDArray[np.float32], base: int, stride: int, taps: Array) -> tuple[float, float]:
    """Windowed gradient around the pixel `base` by the taps of a phase, and its first moment."""
    zeroth = first = 0.0
    start = base - (len(taps) // 2) * stride
    for tap in range(len(taps)):
        # Unsigned: no index could count from the end.
        value = grey[np.uint64(start + tap * stride)]
        zeroth += taps[tap, 0] * value
        first += taps[tap, 1] * value
    return zeroth, first


@kernel_part
def _profile_variance(pixels: Pixels, axis: int, along: int, place: float) -> float:
    """Variance of the gradient's profile within the window around a place in a column, px^2."""
    stride, base = (1, along * pixels.width) if axis == 1 else (pixels.width, along)
    row = math.floor(place + 0.5)
    phase = math.floor((place - row + 0.5) * PHASES + 0.5)
    zeroth = first = second = 0.0
    half = NARROW_TAPS.shape[1] // 2
    for tap in range(2 * half + 1):
        value = pixels.grey[base + (row + tap - half) * stride]
        zeroth += NARROW_TAPS[phase, tap, 0] * value
        first += NARROW_TAPS[phase, tap, 1] * value
        second += NARROW_TAPS[phase, tap, 2] * value
    return second / zeroth - (first / zeroth) ** 2


@kernel_part(forceinline=True)
def _peak(
    pixels: Pixels, taps: Array, axis: int, along: int, guess: tuple[float, float]
) -> tuple[float, float]:
    """Place of the gradient's peak in a column, NaN for none, and the gradient there.

    guess: where it may be, and distance to the peak over distance to the centroid in the window.
    """
    start, gain = guess
    size, stride, base = pixels.height, pixels.width, along
    if axis == 1:
        size, stride, base = pixels.width, 1, along * pixels.width
    place, reach = start, taps.shape[1] // 2 + 1
    for _ in range(PEAK_ROUNDS):
        if not (place >= reach and place < size - reach - 1):
            break
        row = math.floor(place + 0.5)
        phase = math.floor((place - row + 0.5) * PHASES + 0.5)
        gradient, first = _moments(pixels.grey, base + row * stride, stride, taps[np.uint64(phase)])
        if gradient == 0.0:
            break
        centroid = first / gradient
        step = min(max(gain * centroid, -MAX_PEAK_STEP_PX), MAX_PEAK_STEP_PX)
        place = row + phase / PHASES - 0.5 + step
        if abs(step) < CONVERGED_PEAK_STEP_PX:
            return place, gradient
    return math.nan, 0.0


@kernel
def look_half_way(pixels: Pixels, curve: Array, turned: Array, result: Array) -> None:
    """Strength and blur half way along each segment, where an edge is at its clearest.

    curve (a, b, 4, 2); turned (4, 2): scratch; result (2, a, b): gradient across,
    grey / px, with the sign of even segments, and variance of the edge's blur, px^2; NaN where
    there is none, and on every second of many segments.
    """
    result[:] = math.nan
    step = 2 if curve.shape[0] * curve.shape[1] > MANY_SEGMENTS else 1
    for i in range(curve.shape[0]):
        for j in range(i % step, curve.shape[1], step):
            axis = _turn(curve[i, j], turned)
            if axis < 0:
                continue
            half = ((turned[3, 0] / 2 + turned[2, 0]) / 2 + turned[1, 0]) / 2 + turned[0, 0]
            along = math.floor(half + 0.5)
            if along < 0 or along >= (pixels.height if axis == 1 else pixels.width):
                continue
            _, across, speed_along, speed_across = _at(turned, along, 0.5)
            place, gradient = _peak(pixels, NARROW_TAPS, axis, along, (across, 2.0))
            if not abs(place - across) < SEARCH_PX:
                continue
            result[0, i, j] = gradient if (i + j) % 2 == 0 else -gradient
            variance = _profile_variance(pixels, axis, along, place)
            if 0.0 < variance < 0.97 * MIN_WINDOW_PX**2:
                profile = variance * MIN_WINDOW_PX**2 / (MIN_WINDOW_PX**2 - variance) - BOX
                result[1, i, j] = profile / (1 + (speed_across / speed_along) ** 2)


@kernel_part(fastmath=NAN_SAFE, forceinline=True)
def _pull(
    normal: tuple[float, float], distance: float, slope: float, blur: float, extra: float
) -> tuple[float, float, float]:
    """What the crossing gridline does to the ridge at that distance, px, from it.

    Returns its pull along the column, px, the share of the gradient that is left, 0 where it is
    too near, and how much the pull grows with the slope, px.  normal: the crossing gridline's,
    towards the segment; slope: across per along of the segment; extra: variance of the window and
    the central difference, px^2.

    A blurred corner is I = E[sign(u + U) sign(v + V)] at distances u, v from its two gridlines,
    where U, V are normal and, for gridlines askew, correlated.  The pull is a Newton step from
    u = 0 towards the zero of I's second derivative along the column, on which (du, dv) = (1, b).
    """
    normal_along, normal_across = normal
    if distance * distance > FARTHEST_CROSSING**2 * (blur + extra):
        return 0.0, 1.0, 0.0
    scale = 1 / math.sqrt(1 + slope * slope)
    var_u = blur + extra * scale * scale
    var_v = blur + extra * normal_across * normal_across
    cov = (blur * (normal_across - slope * normal_along) + extra * normal_across) * scale
    determinant = var_u * var_v - cov * cov
    w = distance * math.sqrt(var_u / determinant)
    if not w > NEAREST_CROSSING:
        return 0.0, 0.0, 0.0
    if w >= FARTHEST_CROSSING:
        return 0.0, 1.0, 0.0
    v, b = distance, normal_across / scale
    index = int(w * STEPS_PER_UNIT)
    share = BELL[index, 1]
    i_u = 2 * BELL[0, 0] / math.sqrt(var_u) * share
    i_uv = 4 * BELL[0, 0] * BELL[index, 0] / math.sqrt(determinant)
    std_v = math.sqrt(var_v)
    beside = -cov * v / (std_v * math.sqrt(determinant))
    nearest = BELL[int(min(v / std_v, FARTHEST_CROSSING) * STEPS_PER_UNIT), 0]
    lean = BELL[int(min(abs(beside), FARTHEST_CROSSING) * STEPS_PER_UNIT), 1]
    i_v = math.copysign(2 / std_v * nearest * lean, beside)
    i_vv = -(v * i_v + cov * i_uv) / var_v
    skew = 2 * b - cov / var_u - b * b * cov / var_v
    second = skew * i_uv - b * b * v / var_v * i_v
    third = -i_u / var_u - b * b / var_v * (b * i_v + v * (i_uv + b * i_vv))
    third += skew * i_uv * v * (cov - b * var_u) / determinant
    if not third < -LEAST_PEAK * i_u / var_u:
        return 0.0, 0.0, 0.0
    lean = -blur * normal_along * i_uv / (var_u * third)
    return -second / (third * scale), share, lean


@kernel_part(forceinline=True)
def _set_normals(segments: Segments, i: int, j: int, axis: int, normals: Array) -> None:
    """Normals (2, 3) of the gridlines that cross at both ends: along, across, offset."""
    for end in range(2):
        x = segments.crossing[i, j + end, axis]
        y = segments.crossing[i, j + end, 1 - axis]
        if math.isnan(x):
            # None of its other corners is known: taken to cross straight.
            x, y = 0.0, 1.0
        length = math.sqrt(x * x + y * y)
        along, across = y / length, -x / length
        start = segments.corners[i, j + end]
        other = segments.corners[i, j + 1 - end]
        chord = (other[axis] - start[axis]) * along + (other[1 - axis] - start[1 - axis]) * across
        if chord < 0:
            along, across = -along, -across
        normals[end, 0], normals[end, 1] = along, across
        normals[end, 2] = start[axis] * along + start[1 - axis] * across


@kernel_part(forceinline=True)
def _is_doubtful(doubtful: NDArray[np.bool_], t: float) -> bool:
    n = len(doubtful)
    if n == 0:
        return False
    marker = math.floor(t * (n + 1) + 0.5) - 1
    return bool(doubtful[min(max(marker, 0), n - 1)])


@kernel_part(fastmath=NAN_SAFE, forceinline=True)
def _measure_column(
    pixels: Pixels,
    edges: Edges,
    turned: Array,
    normals: Array,
    place: tuple[int, int, float, float, float],
) -> tuple[float, float, float, float, float, float]:
    """What `measure` finds in one column, a variance for the weight, 0 for none; then the ridge.

    place: axis, along, guess of the parameter, guess of the ridge's distance from the curve, sign
    that the gradient must have.
    """
    axis, along, guess, known, sign = place
    t, across, speed_along, speed_across = _at(turned, along, guess)
    slope = speed_across / speed_along
    nothing = (t, 0.0, 0.0, 0.0, 0.0, known)
    pull, unsure, lean, left = 0.0, 0.0, 0.0, sign
    extra = BOX + edges.window**2
    for end in range(2):
        distance = normals[end, 0] * along + normals[end, 1] * across - normals[end, 2]
        normal = normals[end, 0], normals[end, 1]
        part, share, growth = _pull(normal, distance, slope, edges.blur, extra)
        pull += part
        unsure += abs(part) * (PULL_ERROR + PULL_ERROR_SQUARE * abs(part))
        unsure += CROSSING_ERROR * abs(growth)
        lean += growth
        left *= share
    if left == 0.0 or not 0 < t < 1:
        return nothing
    profile = edges.blur * (1 + slope * slope) + extra
    gain = profile / edges.window**2
    if edges.window == MIN_WINDOW_PX:
        # A constant table, which takes less time: most frames are sharp.
        ridge, gradient = _peak(pixels, NARROW_TAPS, axis, along, (across + known, gain))
    else:
        ridge, gradient = _peak(pixels, edges.taps, axis, along, (across + known, gain))
    if not gradient * left > WEAKEST_GRADIENT * edges.gradient * left * left:
        return nothing
    if not abs(gradient) > LEAST_SIGNAL * edges.gradient_noise:
        return nothing
    variance = edges.noise * (profile / gradient) ** 2
    variance += unsure**2 + MODEL_ERROR**2
    # Blur averages the gridline along itself: a bent one is seen shifted inwards.
    inwards = 0.5 * edges.blur * (1 - 3 * slope * slope * edges.blur / profile)
    bend_across = 6 * turned[3, 1] * t + 2 * turned[2, 1]
    bend_along = 6 * turned[3, 0] * t + 2 * turned[2, 0]
    per_along = 1 / (speed_along * speed_along)
    bend = (bend_across - slope * bend_along) * per_along
    deviation = ridge - across - pull - inwards * bend
    flattening = inwards * per_along * math.pi**2
    return t, deviation, variance, flattening, lean / speed_along, ridge - across


@kernel_part(forceinline=True)
def _measure_segment(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    pixels: Pixels, edges: Edges, segments: Segments, i: int, j: int, turned: Array,
    normals: Array, columns: NDArray[np.float32], lane: int,
) -> int:  # fmt: skip
    axis = _turn(segments.curve[i, j], turned)
    if axis < 0:
        return 0
    _set_normals(segments, i, j, axis, normals)
    begin, end = segments.corners[i, j, axis], segments.corners[i, j + 1, axis]
    span, direction = abs(end - begin), 1 if end > begin else -1
    step = max(2 if span > SUBSAMPLED_ABOVE_PX else 1, int(span / MAX_COLUMNS) + 1)
    search = min(SEARCH_PX, SEARCH_SHARE * span)
    size = pixels.height if axis == 1 else pixels.width
    # The columns lie evenly about the segment's middle.
    steps = int((span / 2 - 1e-9) / step)
    along = math.floor((begin + end) / 2 + 0.5) - direction * steps * step
    sign = edges.sign if (i + j) % 2 == 0 else -edges.sign
    known, count = 0.0, 0
    for _ in range(2 * steps + 1):
        here = along
        along += step * direction
        guess = abs(here - begin) / span
        if here < 0 or here >= size or _is_doubtful(segments.doubtful[i, j], guess):
            continue
        t, deviation, variance, flattening, lean, found = _measure_column(
            pixels, edges, turned, normals, (axis, here, guess, known, sign)
        )
        if variance == 0.0 or abs(found) > search or count == MAX_COLUMNS:
            continue
        known = found
        columns[0, count, lane] = t
        columns[1, count, lane] = deviation
        columns[2, count, lane] = step / variance
        columns[3, count, lane] = flattening
        columns[4, count, lane] = lean
        count += 1
    return count


@kernel
def measure(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    pixels: Pixels, edges: Edges, segments: Segments, scratch: tuple[Array, Array],
    counts: Index, columns: NDArray[np.float32],
) -> None:  # fmt: skip
    """Measure how far every gridline runs from its curve, in pixel columns along it.

    scratch: (4, 2) and (2, 3).  Results: counts (s,): measured columns of segment s; columns
    (blocks, 5, MAX_COLUMNS, lanes), s = block * lanes + lane: parameter t on the curve, deviation
    of the gridline along the column px, its weight 1 / px^2, how much blur flattens sin(k pi t)
    over k^2, how much the measured deviation grows with the true one's derivative by t; the
    weight is 0 past the last one.
    """
    turned, normals = scratch
    columns[:, 2] = 0.0
    lanes = columns.shape[3]
    for i in range(segments.curve.shape[0]):
        for j in range(segments.curve.shape[1]):
            s = i * segments.curve.shape[1] + j
            counts[s] = _measure_segment(
                pixels, edges, segments, i, j, turned, normals, columns[s // lanes], s % lanes
            )
