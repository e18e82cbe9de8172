"""A corner that is itself destroyed, measured as the crossing of the gridlines around it."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cmp_tactile_processing.image.bilinear import sample

__all__ = ["edge_crossings"]

# Where the edges are measured along each of a corner's four arms, in steps of the lattice: beyond
# a spot on the corner, short of where the next corner bends the edge.
ARM = np.array([0.3, 0.4, 0.5, 0.6, 0.7])
# The edge is looked for this far to either side, in steps, at so many places.
REACH, PLACES = 0.26, 13
# Points an arm must have for its gridline to be known.
LEAST_ON_ARM = 2
# Spread of the points about their gridline; slope and bend that a gridline has against the mean
# step of its neighbours; all in steps.
SPREAD, USUAL_SLOPE, USUAL_BEND = 0.015, 0.1, 0.03
ROUNDS = 8
# An edge's steepest part must rise by this share of the corner's amplitude per step of the search.
LEAST_SLOPE = 0.1


def edge_crossings(
    smooth: NDArray[np.float32],
    guess: NDArray[np.float64],
    row_step: NDArray[np.float64],
    col_step: NDArray[np.float64],
    amplitude: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Crossings of the two gridlines around guesses (n, 2) px; NaN where an arm is not seen.

    row_step, col_step (n, 2): px from a corner to the next along i and along j.  amplitude (n,):
    grey levels by which the corners around differ, positive where the dark checkers touch along
    the diagonal (-, -) to (+, +).  A parabola is fitted to the steepest places of the edges on
    both arms of each gridline, spots left out.
    """
    crossing = np.full_like(guess, np.nan)
    _cross(smooth, guess, row_step, col_step, amplitude, crossing)
    return crossing


@njit(cache=True, nogil=True)
def _cross(  # noqa: PLR0913, PLR0917 - one array for each property of the corners
    smooth: NDArray[np.float32],
    guess: NDArray[np.float64],
    row_step: NDArray[np.float64],
    col_step: NDArray[np.float64],
    amplitude: NDArray[np.float64],
    crossing: NDArray[np.float64],
) -> None:
    for n in range(len(guess)):
        # Offset along i of the line that runs along j, and the other way round.
        across_i = _line(smooth, guess[n], col_step[n], row_step[n], amplitude[n])
        across_j = _line(smooth, guess[n], row_step[n], col_step[n], amplitude[n])
        i = j = 0.0
        for _ in range(4):
            i = across_i[0] + j * (across_i[1] + j * across_i[2])
            j = across_j[0] + i * (across_j[1] + i * across_j[2])
        if abs(i) < REACH and abs(j) < REACH:
            for d in range(2):
                crossing[n, d] = guess[n, d] + i * row_step[n, d] + j * col_step[n, d]


@njit(cache=True, nogil=True)
def _line(
    smooth: NDArray[np.float32],
    centre: NDArray[np.float64],
    along: NDArray[np.float64],
    across: NDArray[np.float64],
    amplitude: float,
) -> tuple[float, float, float]:
    """Offset across, slope and bend of a gridline as a parabola in steps along it."""
    count = 2 * len(ARM)
    place, offset = np.empty(count), np.empty(count)
    for k in range(len(ARM)):
        for side in range(2):
            sign = 1.0 if side else -1.0
            place[2 * k + side] = sign * ARM[k]
            # Towards (+, +) of an even corner it grows dark, towards (-, +) light.
            offset[2 * k + side] = _steepest(
                smooth,
                centre[0] + sign * ARM[k] * along[0],
                centre[1] + sign * ARM[k] * along[1],
                across,
                -sign * amplitude,
            )
    arms = np.zeros(2, dtype=np.int64)
    for k in range(count):
        if not np.isnan(offset[k]):
            arms[k % 2] += 1
    if arms.min() < LEAST_ON_ARM:
        return np.nan, np.nan, np.nan
    return _robust_parabola(place, offset)


@njit(cache=True, nogil=True)
def _steepest(
    smooth: NDArray[np.float32], x: float, y: float, across: NDArray[np.float64], rise: float
) -> float:
    """Offset in steps across of the steepest place with the sign of `rise`; NaN without one."""
    value = np.empty(PLACES)
    spacing = 2.0 * REACH / (PLACES - 1)
    for k in range(PLACES):
        s = -REACH + k * spacing
        value[k] = sample(smooth, x + s * across[0], y + s * across[1])
    sign = 1.0 if rise > 0 else -1.0
    best, top = 0, LEAST_SLOPE * abs(rise)
    for k in range(2, PLACES - 2):
        slope = sign * (value[k + 1] - value[k - 1])
        if slope > top:
            best, top = k, slope
    if best == 0:
        return np.nan
    left = sign * (value[best] - value[best - 2])
    right = sign * (value[best + 2] - value[best])
    bend = left - 2.0 * top + right
    shift = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return -REACH + (best + shift) * spacing if abs(shift) <= 1.0 else np.nan


@njit(cache=True, nogil=True)
def _robust_parabola(
    place: NDArray[np.float64], offset: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Parabola through most of the points whose offset is known (iterated Cauchy weights)."""
    known = offset[~np.isnan(offset)]
    fit = (np.median(known), 0.0, 0.0)
    for _ in range(ROUNDS):
        matrix, right = np.zeros((3, 3)), np.zeros(3)
        matrix[1, 1] += (SPREAD / USUAL_SLOPE) ** 2
        matrix[2, 2] += (SPREAD / USUAL_BEND) ** 2
        for k in range(len(place)):
            if np.isnan(offset[k]):
                continue
            residual = offset[k] - fit[0] - place[k] * (fit[1] + place[k] * fit[2])
            weight = 1.0 / (1.0 + (residual / SPREAD) ** 2)
            for a in range(3):
                right[a] += weight * place[k] ** a * offset[k]
                for b in range(3):
                    matrix[a, b] += weight * place[k] ** (a + b)
        solution = np.linalg.solve(matrix, right)
        fit = (solution[0], solution[1], solution[2])
    return fit
