"""What the corners around a corner say about it: its steps, its place, whether it belongs there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from cmp_tactile_processing.cache.kernels import kernel

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Where the edges are measured along each of a corner's four arms, in steps of the lattice: beyond
# a spot on the corner, short of where the next corner bends the edge.
ARM = np.array([0.3, 0.4, 0.5, 0.6, 0.7])
# The edge is looked for this far to either side, in steps, at so many places.
EDGE_REACH, PLACES = 0.26, 13
# Points an arm must have for its gridline to be known.
LEAST_ON_ARM = 2
# Standard deviations in steps: of the points from their gridline, of a gridline's slope and of its
# bend against the mean step of its neighbours.
POINT_STD_STEPS = 0.015
SLOPE_PRIOR_STD = 0.1
BEND_PRIOR_STD = 0.03
ROUNDS = 8
# An edge's steepest part must rise by this share of the corner's amplitude per step of the search.
LEAST_SLOPE = 0.1


def local_steps(
    corners: NDArray[np.float64],
    nominal_row_step: NDArray[np.float64],
    nominal_col_step: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Steps along i and along j at corners (rows, cols, 2) px, (rows, cols, 2) px each.

    Half the way between the neighbours on either side, the way to the one that is known, or the
    nominal step where none is.
    """
    row_step, col_step = np.empty_like(corners), np.empty_like(corners)
    _steps(corners, nominal_row_step, row_step)
    _steps(corners.swapaxes(0, 1), nominal_col_step.swapaxes(0, 1), col_step.swapaxes(0, 1))
    return row_step, col_step


def predicted_places(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where the neighbours put each corner of (rows, cols, 2) px, known or not; else NaN.

    The mean over both gridlines of what two neighbours in a row leave room for.
    """
    places = np.empty_like(corners)
    _places(corners, places)
    return places


def off_neighbours(
    corners: NDArray[np.float64], side_px: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`place_between`, and how far from there each corner is, (rows, cols) sides; 0: not known."""
    places, off = place_between(corners), np.empty(corners.shape[:2])
    _distances(corners, places, side_px, off)
    return places, off


def place_between(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where the cubics through two neighbours on either side put each corner, (rows, cols, 2) px.

    The middle of the two neighbours where further ones are missing; the mean over both gridlines;
    NaN for corners without known neighbours on either side along some gridline.
    """
    places = np.empty_like(corners)
    _between(corners, places)
    return places


def border_of(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values (rows, cols, d) along i = 0, the last i, j = 0, the last j: (2 (rows + cols), d)."""
    return np.concatenate([values[0], values[-1], values[:, 0], values[:, -1]])


def outside_corners(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where a further line of corners would lie beyond each side of a grid (rows, cols, 2) px.

    In the order of `border_of`.
    """
    inwards = np.concatenate([corners[1], corners[-2], corners[:, 1], corners[:, -2]])
    return np.asarray(2 * border_of(corners) - inwards)


def known_beside(known: Mask, outside: bool = False) -> tuple[Mask, Mask, Mask, Mask]:
    """Whether the neighbours at i - 1, i + 1, j - 1 and j + 1 are known, (rows, cols) each.

    outside: what counts beyond the borders of the grid.
    """
    padded = np.pad(known, 1, constant_values=outside)
    return padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]


@kernel
def _steps(
    corners: NDArray[np.float64], nominal: NDArray[np.float64], step: NDArray[np.float64]
) -> None:
    rows, cols = corners.shape[:2]
    for i in range(rows):
        for j in range(cols):
            first, last = i, i
            if i > 0 and not np.isnan(corners[i - 1, j, 0]):
                first = i - 1
            if i + 1 < rows and not np.isnan(corners[i + 1, j, 0]):
                last = i + 1
            known = not np.isnan(corners[i, j, 0])
            for d in range(2):
                if last - first == 2 or (known and last > first):
                    step[i, j, d] = (corners[last, j, d] - corners[first, j, d]) / (last - first)
                else:
                    step[i, j, d] = nominal[i, j, d]


@kernel
def _places(corners: NDArray[np.float64], places: NDArray[np.float64]) -> None:
    rows, cols = corners.shape[:2]
    for i in range(rows):
        for j in range(cols):
            count, x, y = 0, 0.0, 0.0
            for di, dj in ((1, 0), (0, 1)):
                for near, far in ((-1, 1), (-1, -2), (1, 2)):
                    a, b = i + near * di, j + near * dj
                    c, d = i + far * di, j + far * dj
                    if min(a, b, c, d) < 0 or max(a, c) >= rows or max(b, d) >= cols:
                        continue
                    weight = 0.5 if far == 1 else 2.0
                    u = weight * corners[a, b, 0] + (1.0 - weight) * corners[c, d, 0]
                    v = weight * corners[a, b, 1] + (1.0 - weight) * corners[c, d, 1]
                    if not np.isnan(u):
                        x, y, count = x + u, y + v, count + 1
            places[i, j, 0] = x / count if count else np.nan
            places[i, j, 1] = y / count if count else np.nan


@kernel
def _between(corners: NDArray[np.float64], places: NDArray[np.float64]) -> None:
    rows, cols = corners.shape[:2]
    for i in range(rows):
        for j in range(cols):
            for d in range(2):
                count, total = 0, 0.0
                for di, dj in ((1, 0), (0, 1)):
                    if i < di or j < dj or i + di >= rows or j + dj >= cols:
                        continue
                    near = corners[i - di, j - dj, d] + corners[i + di, j + dj, d]
                    value = near / 2.0
                    if i >= 2 * di and j >= 2 * dj and i + 2 * di < rows and j + 2 * dj < cols:
                        far = (
                            corners[i - 2 * di, j - 2 * dj, d] + corners[i + 2 * di, j + 2 * dj, d]
                        )
                        if not np.isnan(far):
                            value = (4.0 * near - far) / 6.0
                    if not np.isnan(value):
                        total, count = total + value, count + 1
                places[i, j, d] = total / count if count else np.nan


@kernel
def _distances(
    corners: NDArray[np.float64],
    places: NDArray[np.float64],
    unit: float,
    distance: NDArray[np.float64],
) -> None:
    for i in range(corners.shape[0]):
        for j in range(corners.shape[1]):
            x, y = corners[i, j, 0] - places[i, j, 0], corners[i, j, 1] - places[i, j, 1]
            length = np.sqrt(x * x + y * y) / unit
            distance[i, j] = 0.0 if np.isnan(length) else length


# A corner that is itself destroyed, measured as the crossing of the gridlines around it.


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
    if not len(guess):
        return np.empty_like(guess)
    # Offset along i of the lines that run along j, and the other way round.
    across_i = _lines(smooth, guess, col_step, row_step, amplitude)
    across_j = _lines(smooth, guess, row_step, col_step, amplitude)
    i = j = np.zeros(len(guess))
    for _ in range(4):
        i = across_i[:, 0] + j * (across_i[:, 1] + j * across_i[:, 2])
        j = across_j[:, 0] + i * (across_j[:, 1] + i * across_j[:, 2])
    near = (np.abs(i) < EDGE_REACH) & (np.abs(j) < EDGE_REACH)
    crossing = guess + i[:, None] * row_step + j[:, None] * col_step
    return np.where(near[:, None], crossing, np.nan)


def _lines(
    smooth: NDArray[np.float32], centre: Float, along: Float, across: Float, amplitude: Float
) -> Float:
    """Offset across, slope and bend (n, 3) of gridlines as parabolas in steps along them."""
    place = np.concatenate([-ARM, ARM])
    # Towards (+, +) of an even corner it grows dark, towards (-, +) light.
    rise = -np.sign(place) * amplitude[:, None]
    offset = _steepest(smooth, centre[:, None] + place[:, None] * along[:, None], across, rise)
    on_arm = np.isfinite(offset).reshape(len(centre), 2, len(ARM)).sum(axis=-1)
    known = (on_arm >= LEAST_ON_ARM).all(axis=-1)
    line = np.full((len(centre), 3), np.nan)
    line[known] = _robust_parabolas(place, offset[known])
    return line


def _steepest(smooth: NDArray[np.float32], at: Float, across: Float, rise: Float) -> Float:
    """Offset in steps across of the steepest places with the sign of `rise` (n, k); else NaN.

    at (n, k, 2) px: where the edges are looked for, along across (n, 2) px.
    """
    offset, spacing = np.linspace(-EDGE_REACH, EDGE_REACH, PLACES, retstep=True)
    x, y = np.moveaxis(at[:, :, None] + offset[:, None] * across[:, None, None], -1, 0)
    value = map_coordinates(smooth, [y, x], output=np.float64, order=1, cval=np.nan)
    slope = np.where(rise > 0, 1.0, -1.0)[..., None] * (value[..., 2:] - value[..., :-2])
    inner = np.where(np.isnan(slope), -np.inf, slope)[..., 1:-1]
    best = inner.argmax(axis=-1)[..., None]
    left, top, right = (np.take_along_axis(slope, best + k, axis=-1)[..., 0] for k in range(3))
    bend = left - 2.0 * top + right
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.where(bend < 0, 0.5 * (left - right) / bend, 0.0)
    seen = (top > LEAST_SLOPE * np.abs(rise)) & (np.abs(shift) <= 1.0)
    return np.where(seen, offset[best[..., 0] + 2] + shift * spacing, np.nan)


def _robust_parabolas(place: Float, offset: Float) -> Float:
    """Parabolas (n, 3) through most of the offsets (n, k) that are known, by Cauchy weights."""
    known = np.isfinite(offset)
    value = np.where(known, offset, 0.0)
    terms = place[:, None] ** np.arange(3)
    products = (terms[:, :, None] * terms[:, None]).reshape(len(place), 9)
    prior = np.diag(
        [0.0, (POINT_STD_STEPS / SLOPE_PRIOR_STD) ** 2, (POINT_STD_STEPS / BEND_PRIOR_STD) ** 2]
    )
    fit = np.zeros((len(offset), 3))
    fit[:, 0] = np.nanmedian(offset, axis=1)
    for _ in range(ROUNDS):
        weight = known / (1.0 + ((value - fit @ terms.T) / POINT_STD_STEPS) ** 2)
        matrix = (weight @ products).reshape(-1, 3, 3) + prior
        fit = np.linalg.solve(matrix, ((weight * value) @ terms)[..., None])[..., 0]
    return fit
