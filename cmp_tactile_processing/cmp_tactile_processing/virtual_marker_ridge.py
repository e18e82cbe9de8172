"""Where the grey gradient across a gridline peaks: measured in every pixel column along it.

A column runs along the image axis that is nearer to the gridline's normal; "along" and "across"
are the coordinates of the other axis and of this one.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["COLUMNS", "measure_ridges", "pilot"]

# Columns of a segment at most; in longer segments every second, third, ... column is measured.
COLUMNS = 32
# The peak is that of the gradient smoothed by a Gaussian of WINDOW px within REACH px.
WINDOW, REACH = 1.2, 4
TAPS = 2 * REACH + 3
PHASES = 16
# Variance of the central difference's box, px^2.
BOX = 1.0 / 3.0
# Nearer to a corner than this many standard deviations of the edge's blur nothing is measured.
NEAREST_CROSSING = 1.2
# The crossing gridline's pull on the ridge is known to this share.
PULL_ERROR = 0.25
# What is not modelled (sampling, light, print), px.
MODEL_ERROR = 0.012
# A gradient below this share of the median of all gridlines, or below this many standard
# deviations of its noise, is no edge.
WEAKEST_GRADIENT, LEAST_SIGNAL = 0.12, 4.0
# How far from the curve through the corners a gridline may run, px and share of the segment.
SEARCH_PX, SEARCH_SHARE = 2.5, 0.25
ROUNDS = 4
STEPS_PER_UNIT = 64
LARGEST_CROSSING = 4.0


def _window_taps() -> NDArray[np.float64]:
    """Weights (PHASES + 1, 3, TAPS) of the pixels: smoothed gradient, its moments 1 and 2."""
    taps = np.zeros((PHASES + 1, 3, TAPS))
    offset = np.arange(-REACH, REACH + 1)
    for phase in range(PHASES + 1):
        distance = offset - (phase / PHASES - 0.5)
        weight = np.exp(-(distance**2) / (2 * WINDOW**2))
        for moment in range(3):
            # Weights of the central differences become weights of the pixels.
            part = weight / weight.sum() * distance**moment / 2
            taps[phase, moment, 2:] += part
            taps[phase, moment, :-2] -= part
    return taps


def _crossing_table() -> NDArray[np.float64]:
    """2 phi(w) / (2 Phi(w) - 1) and 2 Phi(w) - 1 over w, (n, 2)."""
    w = (np.arange(int(LARGEST_CROSSING * STEPS_PER_UNIT) + 1) + 0.5) / STEPS_PER_UNIT
    step = np.array([math.erf(x / math.sqrt(2)) for x in w])
    bell = np.exp(-(w**2) / 2) * math.sqrt(2 / math.pi)
    return np.stack([bell / step, step], axis=1)


WINDOW_TAPS = _window_taps()
CROSSING = _crossing_table()


@njit(cache=True, nogil=True, fastmath=True)
def _moments(pixels, base, stride, phase, count, moments):  # type: ignore[no-untyped-def]
    """First `count` moments of the windowed gradient around a pixel and a phase of it."""
    for moment in range(count):
        total = 0.0
        for tap in range(TAPS):
            total += WINDOW_TAPS[phase, moment, tap] * pixels[base + (tap - REACH - 1) * stride]
        moments[moment] = total


@njit(cache=True, nogil=True)
def _parameter_at(curve, axis, value, start):  # type: ignore[no-untyped-def]
    """Parameter t of the curve where its coordinate is `value`, from a first guess."""
    t = start
    for _ in range(2):
        x = ((curve[3, axis] * t + curve[2, axis]) * t + curve[1, axis]) * t + curve[0, axis]
        slope = (3 * curve[3, axis] * t + 2 * curve[2, axis]) * t + curve[1, axis]
        t += (value - x) / slope
    return t


@njit(cache=True, nogil=True)
def pilot(pixels, width, height, curve, odd, result):  # type: ignore[no-untyped-def]
    """Blur and strength half way along each segment, where an edge is at its clearest.

    pixels: the smoothed image (height * width,); curve (a, b, 4, 2); result (a, b, 2): signed
    gradient across (sign as on even segments), grey / px, and variance of the edge's blur across
    the gridline, px^2, both NaN where there is no edge.  odd: 0 or 1, parity of segment (0, 0).
    """
    moments = np.empty(3)
    for i in range(curve.shape[0]):
        for j in range(curve.shape[1]):
            result[i, j, 0] = math.nan
            result[i, j, 1] = math.nan
            c = curve[i, j]
            along_axis = 0
            if abs(c[1, 1] + c[2, 1] + c[3, 1]) > abs(c[1, 0] + c[2, 0] + c[3, 0]):
                along_axis = 1
            across_axis = 1 - along_axis
            middle = ((c[3, along_axis] / 2 + c[2, along_axis]) / 2 + c[1, along_axis]) / 2
            middle += c[0, along_axis]
            if not math.isfinite(middle) or not math.isfinite(c[3, across_axis]):
                continue
            along = int(math.floor(middle + 0.5))
            t = _parameter_at(c, along_axis, along, 0.5)
            across = ((c[3, across_axis] * t + c[2, across_axis]) * t + c[1, across_axis]) * t
            across += c[0, across_axis]
            slope = (3 * c[3, across_axis] * t + 2 * c[2, across_axis]) * t + c[1, across_axis]
            slope /= (3 * c[3, along_axis] * t + 2 * c[2, along_axis]) * t + c[1, along_axis]
            along_size, across_size = (width, height) if along_axis == 0 else (height, width)
            along_stride, stride = (1, width) if along_axis == 0 else (width, 1)
            if along < 0 or along >= along_size:
                continue
            place = across
            found = False
            for _ in range(ROUNDS):
                if not (place >= REACH + 2 and place < across_size - REACH - 3):
                    break
                row = int(math.floor(place + 0.5))
                phase = int(math.floor((place - row + 0.5) * PHASES + 0.5))
                _moments(pixels, along * along_stride + row * stride, stride, phase, 3, moments)
                if moments[0] == 0.0:
                    break
                shift = moments[1] / moments[0]
                if abs(shift) > 1.5:
                    break
                quantised = row + phase / PHASES - 0.5
                place = quantised + 2 * shift
                if abs(shift) < 0.1:
                    found = True
                    break
            if not found or abs(place - across) > SEARCH_PX:
                continue
            variance = moments[2] / moments[0] - shift * shift
            sign = 1.0 if (i + j + odd) % 2 == 0 else -1.0
            result[i, j, 0] = sign * moments[0]
            if variance > 0.05 and variance < 0.95 * WINDOW**2:
                across_variance = variance * WINDOW**2 / (WINDOW**2 - variance) - BOX
                result[i, j, 1] = across_variance / (1 + slope * slope)


@njit(cache=True, nogil=True)
def _crossing(tangent, along_axis, place, corner, slope, blur):  # type: ignore[no-untyped-def]
    """Pull of the gridline that crosses at a corner on the ridge, and share of the gradient left.

    tangent, corner (2,): the crossing gridline's; place: along, across; slope: across per along of
    the gridline itself; blur: variance of the edge's blur, px^2.  Returns the distance from the
    crossing gridline in standard deviations, the pull in px along the column, and the share.
    """
    across_axis = 1 - along_axis
    length = math.sqrt(tangent[0] ** 2 + tangent[1] ** 2)
    n_along = tangent[across_axis] / length
    n_across = -tangent[along_axis] / length
    distance = n_along * (place[0] - corner[along_axis])
    distance += n_across * (place[1] - corner[across_axis])
    if distance < 0:
        distance, n_along, n_across = -distance, -n_along, -n_across
    scale = 1 / math.sqrt(1 + slope * slope)
    extra = BOX + WINDOW**2
    var_u = blur + extra * scale * scale
    var_v = blur + extra * n_across * n_across
    cov = blur * scale * (n_across - slope * n_along) + extra * scale * n_across
    spread = math.sqrt(max(var_v - cov * cov / var_u, 0.1 * var_v))
    w = distance / spread
    index = int(w * STEPS_PER_UNIT)
    if index >= CROSSING.shape[0]:
        return w, 0.0, 1.0
    pull = (2 * n_across / scale - cov / var_u) * var_u / spread * CROSSING[index, 0] / scale
    return w, pull, CROSSING[index, 1]


@njit(cache=True, nogil=True)
def measure_ridges(  # type: ignore[no-untyped-def]  # noqa: PLR0913, PLR0917
    pixels,
    width,
    height,
    corners,
    curve,
    crossing,
    doubtful,
    settings,
    counts,
    columns,
):
    """Measure the deviation of every gridline from its curve, in pixel columns along it.

    corners (a, b+1, 2), crossing (a, b+1, 2): tangents of the gridlines that cross; curve
    (a, b, 4, 2); doubtful (a, b, n): markers that must not be measured, n = 0 for none;
    settings: variance of the blur px^2, median gradient grey / px, sign of the gradient on
    the segment (0, 0), variance of the deviation times squared gradient for one column when blur
    is 1, standard deviation of the gradient's noise.
    counts (a, b): number of measured columns; columns (a, b, COLUMNS, 5): parameter t on the
    curve, deviation of the ridge across px, its variance, square of dt / d along, curve's
    bend-induced shift per second derivative, px^2.
    """
    blur, typical, first_sign, noise_factor, gradient_noise = settings
    moments = np.empty(3)
    place = np.empty(2)
    for i in range(curve.shape[0]):
        for j in range(curve.shape[1]):
            counts[i, j] = 0
            c = curve[i, j]
            reach_x = c[1, 0] + c[2, 0] + c[3, 0]
            reach_y = c[1, 1] + c[2, 1] + c[3, 1]
            if not (math.isfinite(reach_x) and math.isfinite(reach_y)):
                continue
            along_axis = 1 if abs(reach_y) > abs(reach_x) else 0
            across_axis = 1 - along_axis
            along_size, across_size = (width, height) if along_axis == 0 else (height, width)
            along_stride, stride = (1, width) if along_axis == 0 else (width, 1)
            begin, end = corners[i, j, along_axis], corners[i, j + 1, along_axis]
            direction = 1 if end > begin else -1
            span = abs(end - begin)
            step = int(span / COLUMNS) + 1
            search = min(SEARCH_PX, SEARCH_SHARE * span)
            sign = first_sign if (i + j) % 2 == 0 else -first_sign
            along = int(math.ceil(begin)) if direction > 0 else int(math.floor(begin))
            known = 0.0
            count = 0
            while (end - along) * direction > 0 and count < COLUMNS:
                here = along
                along += step * direction
                if here < 0 or here >= along_size:
                    continue
                t = _parameter_at(c, along_axis, here, abs(here - begin) / span)
                if not (t > 0 and t < 1):
                    continue
                if doubtful.shape[2] > 0:
                    marker = int(math.floor(t * (doubtful.shape[2] + 1) + 0.5)) - 1
                    marker = min(max(marker, 0), doubtful.shape[2] - 1)
                    if doubtful[i, j, marker]:
                        continue
                across = (c[3, across_axis] * t + c[2, across_axis]) * t + c[1, across_axis]
                across = across * t + c[0, across_axis]
                v_along = (3 * c[3, along_axis] * t + 2 * c[2, along_axis]) * t + c[1, along_axis]
                v_across = (3 * c[3, across_axis] * t + 2 * c[2, across_axis]) * t
                v_across += c[1, across_axis]
                slope = v_across / v_along
                place[0], place[1] = here, across
                w_a, pull_a, share_a = _crossing(
                    crossing[i, j], along_axis, place, corners[i, j], slope, blur
                )
                w_b, pull_b, share_b = _crossing(
                    crossing[i, j + 1], along_axis, place, corners[i, j + 1], slope, blur
                )
                if not (w_a > NEAREST_CROSSING and w_b > NEAREST_CROSSING):
                    continue
                profile = blur * (1 + slope * slope) + BOX
                gain = (profile + WINDOW**2) / WINDOW**2
                trial = across + known
                good = False
                for _ in range(ROUNDS):
                    if not (trial >= REACH + 2 and trial < across_size - REACH - 3):
                        break
                    row = int(math.floor(trial + 0.5))
                    phase = int(math.floor((trial - row + 0.5) * PHASES + 0.5))
                    _moments(pixels, here * along_stride + row * stride, stride, phase, 2, moments)
                    gradient = moments[0] * sign
                    if gradient < LEAST_SIGNAL * gradient_noise:
                        break
                    shift = gain * moments[1] * sign / gradient
                    shift = min(max(shift, -1.5), 1.5)
                    trial = row + phase / PHASES - 0.5 + shift
                    if abs(trial - across) > search:
                        break
                    if abs(shift) < 0.3:
                        good = True
                        break
                if not good or gradient < WEAKEST_GRADIENT * typical * share_a * share_b:
                    continue
                known = trial - across
                pull = pull_a + pull_b
                variance = noise_factor * (profile + WINDOW**2) ** 2 / gradient**2 / step
                variance += (PULL_ERROR * (abs(pull_a) + abs(pull_b))) ** 2 + MODEL_ERROR**2
                # Blur averages the gridline along itself: a bent one is seen shifted inwards.
                bend_shift = 0.5 * blur * (1 - 3 * slope * slope * blur / (profile + WINDOW**2))
                a_along = 6 * c[3, along_axis] * t + 2 * c[2, along_axis]
                a_across = 6 * c[3, across_axis] * t + 2 * c[2, across_axis]
                bend = (a_across - slope * a_along) / (v_along * v_along)
                columns[i, j, count, 0] = t
                columns[i, j, count, 1] = known - pull - bend_shift * bend
                columns[i, j, count, 2] = variance
                columns[i, j, count, 3] = 1 / (v_along * v_along)
                columns[i, j, count, 4] = bend_shift
                count += 1
            counts[i, j] = count
