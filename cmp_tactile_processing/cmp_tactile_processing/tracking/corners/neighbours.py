"""What the corners around a corner say about it: its steps, its place, whether it belongs there.

Stray corners are those whose displacement does not continue that of the rest: another pattern's.
Detected corners show a seam between two patterns where the gridlines jump.  Where they happen to
meet evenly only sub-pixel corners show it: a gel's displacement bends little from corner to corner.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_processing.tracking.detector import NominalGrid

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]
# Largest second difference of the displacement, in sides, beside missing corners: a seam destroys
# corners along it.  0.1 is reached near covers, 0.17 under the sharpest contact of the samples.
LARGEST_BEND = 0.1
# In a complete grid a second pattern's displacement jumps from one corner to the next, in sides.  A
# gel's has kinks: beside a rigid bar that shears it by four checkers it bends by 0.6, but jumps by
# no more than 0.3; under a cuboid's corner 1 mm deep by 0.44 and 0.38.
LARGEST_JUMP = 0.4
# Of what is connected with such a corner, all counts that bends by this share of it.
ALSO_BENT = 0.4
# On a ragged print all corners scatter: a seam stands out from the median by this factor.
TYPICAL_BENDS = 4.0
# RMS distance in sides of two parts from a surface of second order through both: so much if they
# touch, and more by the gap's square in checkers.  Halves of a twisted gel with five lines hidden
# between them reach 0.21, another pattern of nearly the same pitch 0.16 at a gap of three.
LARGEST_MISFIT, MISFIT_OF_GAP = 0.04, 0.0125
# Across a gap wider than this a part needs so many corners for each square checker of the gap: a
# surface bends to fit a few.
NARROW_GAP, CORNERS_OF_GAP = 2, 2
# Corners of the parts that far from one another, beyond the gap, count.
REACH = 3
# A single corner lies within this of the surface through those around it, in sides, or within so
# many times the median second difference: at the grid's own corners a scatter counts most.
LARGEST_STEP, USUAL_STEPS = 0.07, 3.0
# Fewer corners around it say nothing about a part, or of a single corner.
FEWEST_AROUND, FEWEST_AROUND_SINGLE = 8, 6
# Keeps the second order small where too few corners determine it.
STIFFNESS = 1e-3


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

# Where the edges are measured along each of a corner's four arms, in steps of the lattice: beyond
# a spot on the corner, short of where the next corner bends the edge.
ARM = np.array([0.3, 0.4, 0.5, 0.6, 0.7])
# The edge is looked for this far to either side, in steps, at so many places.
EDGE_REACH, PLACES = 0.26, 13
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
    prior = np.diag([0.0, (SPREAD / USUAL_SLOPE) ** 2, (SPREAD / USUAL_BEND) ** 2])
    fit = np.zeros((len(offset), 3))
    fit[:, 0] = np.nanmedian(offset, axis=1)
    for _ in range(ROUNDS):
        weight = known / (1.0 + ((value - fit @ terms.T) / SPREAD) ** 2)
        matrix = (weight @ products).reshape(-1, 3, 3) + prior
        fit = np.linalg.solve(matrix, ((weight * value) @ terms)[..., None])[..., 0]
    return fit


def drop_stray_parts(corners: Float, nominal: NominalGrid) -> int:
    """Set to NaN in `corners` (rows, cols, 2) px what does not continue the largest part.

    Returns how many corners those are.  Parts hang together by whole checkers of which no corner
    is bent; a part, or a corner in none, stays where one smooth surface fits it and what surrounds
    it.
    """
    known = np.isfinite(corners[..., 0])
    if not known.any():
        return 0
    displacement, bend = np.empty_like(corners), np.empty(known.shape)
    steps = nominal.row_step, nominal.col_step
    if _measure_bends(corners, nominal.corners, steps, displacement, bend) <= LARGEST_JUMP:
        return 0
    usual = float(np.median(bend[bend > 0])) if (bend > 0).any() else 0.0
    limit = max(LARGEST_BEND, TYPICAL_BENDS * usual)
    if known.all():
        seam = _jumps(displacement) > max(LARGEST_JUMP, limit)
        if not seam.any():
            return 0
    else:
        seam = _touching((bend > limit) | ~known, ~known) & known
    bent = _touching(bend > ALSO_BENT * limit, seam)
    stray = known & ~_continued(displacement, known, bent, usual)
    corners[stray] = np.nan
    return int(np.count_nonzero(stray))


@kernel
def _measure_bends(
    corners: Float, nominal: Float, steps: tuple[Float, Float], displacement: Float, bend: Float
) -> float:
    """Displacement in sides, and the larger size of its second differences along the gridlines.

    The latter is 0 where not known.  Returns the largest, infinity where a corner is missing.
    """
    row_step, col_step = steps
    largest = 0.0
    rows, cols = bend.shape
    for i in range(rows):
        for j in range(cols):
            side = np.sqrt(row_step[i, j, 0] ** 2 + row_step[i, j, 1] ** 2)
            side = (side + np.sqrt(col_step[i, j, 0] ** 2 + col_step[i, j, 1] ** 2)) / 2
            for d in range(2):
                displacement[i, j, d] = (corners[i, j, d] - nominal[i, j, d]) / side
    bend[:] = 0.0
    for i in range(rows):
        for j in range(cols):
            for di, dj in ((1, 0), (0, 1)):
                if i < di or j < dj or i + di >= rows or j + dj >= cols:
                    continue
                total = 0.0
                for d in range(2):
                    ends = displacement[i - di, j - dj, d] + displacement[i + di, j + dj, d]
                    total += (ends - 2.0 * displacement[i, j, d]) ** 2
                if not np.isnan(total):
                    bend[i, j] = max(bend[i, j], total)
            bend[i, j] = np.sqrt(bend[i, j])
            largest = max(largest, bend[i, j] if not np.isnan(corners[i, j, 0]) else np.inf)
    return largest


def _jumps(displacement: Float) -> Float:
    """By how much a complete grid's displacement jumps beside each corner, the largest, sides.

    Half of the change of the second difference from corner to corner: of a jump all of it, of a
    kink half, and never more than the larger bend of the two.
    """
    jumps = np.zeros(displacement.shape[:2])
    for axis in (0, 1):
        along = np.moveaxis(displacement, axis, 0)
        beside = np.moveaxis(jumps, axis, 0)
        change = np.linalg.norm(np.diff(along, 3, axis=0), axis=-1) / 2
        for corner in (beside[1:-2], beside[2:-1]):
            np.maximum(corner, change, out=corner)
    return jumps


def _touching(mask: Mask, other: Mask) -> Mask:
    """The parts of a mask in which there is something of the other."""
    label = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)[1]
    return np.asarray(mask & np.isin(label, np.unique(label[other & mask])))


def _continued(displacement: Float, known: Mask, bent: Mask, usual: float) -> Mask:
    """The largest part and all that goes on from it."""
    parts = _parts(known & ~bent)
    if not parts:
        return np.zeros_like(known)
    whole, left = parts[0], parts[1:]
    in_parts = np.logical_or.reduce(parts)
    grown = True
    while grown:
        grown = False
        whole = _with_single(displacement, whole, known & ~in_parts, usual)
        for index, part in enumerate(left):
            if _goes_on(displacement, whole, part, usual):
                whole = whole | part
                left.pop(index)
                grown = True
                break
    return whole


def _parts(sound: Mask) -> list[Mask]:
    """Sets of corners that hang together by whole checkers, the largest first."""
    checker = sound[:-1, :-1] & sound[1:, :-1] & sound[:-1, 1:] & sound[1:, 1:]
    count, label = cv2.connectedComponents(checker.astype(np.uint8), connectivity=4)
    parts = []
    for index in range(1, count):
        part = np.zeros_like(sound)
        i, j = np.nonzero(label == index)
        for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)):
            part[i + a, j + b] = True
        parts.append(part)
    parts.sort(key=lambda part: -np.count_nonzero(part))
    return parts


def _goes_on(displacement: Float, whole: Mask, part: Mask, usual: float) -> bool:
    """Whether one smooth surface fits a part and what lies around it."""
    from_whole, from_part = _distance(whole), _distance(part)
    gap = from_whole[part].min()
    near_whole = np.argwhere(whole & ~part & (from_part <= gap + REACH))
    near_part = np.argwhere(part & (from_whole <= gap + REACH))
    too_few = gap > NARROW_GAP and np.count_nonzero(part) < CORNERS_OF_GAP * gap**2
    if too_few or len(near_whole) < FEWEST_AROUND:
        return False
    places = np.concatenate([near_whole, near_part])
    values = displacement[places[:, 0], places[:, 1]]
    terms = _terms(places - near_part.mean(axis=0))
    off = ((values - terms @ _surface(terms, values)) ** 2).sum(axis=1)
    misfit = np.sqrt(max(off[: len(near_whole)].mean(), off[len(near_whole) :].mean()))
    return bool(misfit <= max(LARGEST_MISFIT + MISFIT_OF_GAP * gap**2, usual))


def _with_single(displacement: Float, whole: Mask, single: Mask, usual: float) -> Mask:
    """With the single corners that lie where those around put them, while there are some."""
    whole = whole.copy()
    reach, largest = REACH - 1, max(LARGEST_STEP, USUAL_STEPS * usual)
    added = True
    while added:
        added = False
        for i, j in np.argwhere(single & ~whole & (_distance(whole) <= 1)):
            top, left = max(i - reach, 0), max(j - reach, 0)
            around = np.argwhere(whole[top : i + reach + 1, left : j + reach + 1]) + (top, left)
            if len(around) < FEWEST_AROUND_SINGLE:
                continue
            terms = _terms(around - (i, j))
            surface = _surface(terms, displacement[around[:, 0], around[:, 1]])
            # The surface's constant is its value at the corner itself.
            if np.linalg.norm(displacement[i, j] - surface[0]) <= largest:
                whole[i, j] = added = True
    return whole


def _distance(mask: Mask) -> NDArray[np.float32]:
    """From each corner to the nearest one of the mask, in checkers along the longer way."""
    return np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_C, 3))


def _terms(offset: NDArray[np.float64] | NDArray[np.intp]) -> Float:
    """Terms of a surface of second order at (n, 2) offsets in checkers, (n, 6)."""
    i, j = offset.T / (REACH + 1.0)
    return np.stack([np.ones_like(i), i, j, i * i, i * j, j * j], axis=1)


def _surface(terms: Float, values: Float) -> Float:
    normal = terms.T @ terms
    stiff = STIFFNESS * len(terms) * np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    # A line of corners leaves the slope across it open: held as the rest.
    tilt = 1e-6 * len(terms) * np.eye(len(normal))
    return np.asarray(np.linalg.solve(normal + stiff + tilt, terms.T @ values))
