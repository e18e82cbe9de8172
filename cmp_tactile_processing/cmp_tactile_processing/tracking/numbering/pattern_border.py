"""Where the pattern ends: what lies beyond the outermost corners that are connected."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.image.prepared import PreparedImage

Float = NDArray[np.float64]

# Below this side of a checker the smoothed image has lost the checkers' contrast.
SMOOTHED_FROM_PX = 8.0
# A cell counts where its neighbours within the pattern differ by this many grey levels, and by
# this many standard deviations of the noise, of which a cell's mean keeps about a fifth.
LEAST_CONTRAST, LEAST_CONTRAST_NOISE = 2.0, 0.6
# Share of a line's cells, and number in a row, that must show the same.
LEAST_SHARE, LEAST_RUN = 0.4, 6
FIRM_SHARE = 0.6
# The edge of the outermost checkers lies one cell out: how far the mean may be off (corners are
# known to a pixel or two), by how much it may run aslant, and how it may scatter; in cells.
EDGE_OFF, EDGE_ASLANT, EDGE_SCATTER = 0.35, 0.5, 0.25

# Grey levels per cell along the outermost line: of the checker within, then of this profile
# outwards; depths in cells from the line.
_FIRST_DEPTH, _DEPTH_STEP, _DEPTHS = 0.35, 0.1, 15
_WITHIN = (-0.65, -0.5, -0.35)
_ACROSS = (0.3, 0.5, 0.7)
# Samples of the profile that lie on the outermost checkers and on the margin.
_OUTER, _MARGIN = (1, 5), (11, 15)
# What is counted of a side.
_ENDS, _ENDS_RUN, _GOES_ON, _OVER, _EDGES, _MEAN, _SLOPE, _SCATTER, _LEVEL = range(9)
# In units of the local contrast: checkers differ by more, a margin along itself by less.
_ALTERNATES, _EVEN = 0.4, 0.3
_EDGE_CONTRAST = 0.45


@dataclass(frozen=True)
class BorderSide:
    """What was seen beyond one side of a lattice of corners.

    ends: the pattern ends there, one cell out; firm: so along most of the line;
    goes_on: there are checkers beyond the next gridline too; over: the line of corners lies
    outside the pattern itself; level: the margin's brightness, 0 as the dark checkers, 1 as light.
    """

    ends: bool = False
    firm: bool = False
    goes_on: bool = False
    over: bool = False
    level: float = float("nan")


def border_sides(
    image: PreparedImage, lattice: Float, even: bool, expected: tuple[int, int]
) -> list[BorderSide]:
    """Whether the pattern ends at i = 0, at the last i, at j = 0 and at the last j of a lattice.

    lattice (R, C, 2) px, NaN where a corner is missing, at least 3 x 3; even: whether the dark
    checkers touch corner (0, 0) along the diagonal (-, -) to (+, +); expected: rows, cols of the
    whole pattern.

    Truly ending means that along the outermost line the checkers one cell further out have the
    expected colours and end where the next gridline would be, and that beyond it the colour is the
    same along the line.  An occluder's edge seldom follows a gridline for long.
    """
    rows, cols = lattice.shape[:2]
    step = np.nanmedian(np.linalg.norm(np.diff(lattice[:, : cols // 2 + 1], axis=0), axis=-1))
    picture = image.smooth if step >= SMOOTHED_FROM_PX else image.grey
    floor = max(LEAST_CONTRAST, LEAST_CONTRAST_NOISE * image.noise)
    across = lattice.swapaxes(0, 1)
    # The checker beyond corner 0 of the line, towards corner 1, lies on the diagonal (-, +) of a
    # first row's corner, on (+, +) of a last row's.
    sides = (
        (lattice[:3], not even, expected[1]),
        (lattice[-1:-4:-1], even == (rows % 2 == 1), expected[1]),
        (across[:3], not even, expected[0]),
        (across[-1:-4:-1], even == (cols % 2 == 1), expected[0]),
    )
    counts = np.zeros(9)
    found = []
    for outermost, dark, length in sides:
        lines = np.ascontiguousarray(outermost)
        profile = np.empty((lines.shape[1] - 1, _DEPTHS + 1))
        _measure_profiles(picture, lines, profile)
        _count(profile, dark, floor, counts)
        found.append(_side(counts, max(length, lines.shape[1]) - 2))
    return found


def _side(counts: Float, pairs: int) -> BorderSide:
    """The side by what was counted; pairs: of neighbouring cells along the whole line."""
    need = max(np.ceil(LEAST_SHARE * pairs), min(2, pairs))
    edge = (
        counts[_EDGES] >= max(need // 2, 1)
        and abs(counts[_MEAN] - 1) <= EDGE_OFF
        and abs(counts[_SLOPE]) <= EDGE_ASLANT
        and counts[_SCATTER] <= EDGE_SCATTER
    )
    ends = bool(edge and counts[_ENDS] >= need and counts[_ENDS_RUN] >= min(LEAST_RUN, need))
    return BorderSide(
        ends=ends,
        firm=ends and counts[_ENDS] >= FIRM_SHARE * pairs,
        goes_on=bool(counts[_GOES_ON] >= need),
        over=bool(counts[_OVER] >= need),
        level=float(counts[_LEVEL]),
    )


@kernel
def _measure_profiles(
    picture: NDArray[np.float32] | NDArray[np.uint8], lines: Float, profile: Float
) -> None:
    """Grey levels within and beyond the cells of the outermost of three lines (3, m, 2)."""
    count = lines.shape[1]
    outwards, bend = np.empty((count, 2)), np.empty((count, 2))
    for j in range(count):
        for d in range(2):
            outwards[j, d] = _mean_difference(lines, j, d, 1)
            bend[j, d] = _mean_difference(lines, j, d, 3)
            if np.isnan(bend[j, d]):
                bend[j, d] = 0.0
    ends = np.empty((2, 2))
    for j in range(count - 1):
        total = 0.0
        for depth in _WITHIN:
            _two_ends(lines[0], outwards, bend, (j, depth), ends)
            total += _mean_between(picture, ends)
        profile[j, 0] = total / len(_WITHIN)
        for k in range(_DEPTHS):
            _two_ends(lines[0], outwards, bend, (j, _FIRST_DEPTH + k * _DEPTH_STEP), ends)
            profile[j, k + 1] = _mean_between(picture, ends)


@kernel_part
def _mean_difference(lines: Float, j: int, d: int, reach: int) -> float:
    """Mean near j of the step from line 1 to line 0 (reach 1), or of its change (reach 3)."""
    count, total = 0, 0.0
    for k in range(max(0, j - reach), min(lines.shape[1], j + reach + 1)):
        value = lines[0, k, d] - lines[1, k, d]
        if reach == 3:
            value -= lines[1, k, d] - lines[2, k, d]
        if not np.isnan(value):
            total += value
            count += 1
    return total / count if count else np.nan


@kernel_part
def _two_ends(
    line: Float, outwards: Float, bend: Float, place: tuple[int, float], ends: Float
) -> None:
    """The line's corners j and j + 1 moved outwards by a depth in cells."""
    first, depth = place
    for k in range(2):
        for d in range(2):
            moved = depth * outwards[first + k, d] + 0.5 * depth * (depth + 1) * bend[first + k, d]
            ends[k, d] = line[first + k, d] + moved


@kernel_part
def _mean_between(picture: NDArray[np.float32] | NDArray[np.uint8], ends: Float) -> float:
    """Mean of bilinear samples between two points; NaN where one lies outside."""
    height, width = picture.shape
    total = 0.0
    for u in _ACROSS:
        x = (1.0 - u) * ends[0, 0] + u * ends[1, 0]
        y = (1.0 - u) * ends[0, 1] + u * ends[1, 1]
        if not (x >= 0.0 and y >= 0.0 and x < width - 1 and y < height - 1):
            return np.nan
        left, top = int(x), int(y)
        a, b = x - left, y - top
        above = picture[top, left] * (1.0 - a) + picture[top, left + 1] * a
        below = picture[top + 1, left] * (1.0 - a) + picture[top + 1, left + 1] * a
        total += above * (1.0 - b) + below * b
    return total / len(_ACROSS)


@kernel
def _count(profile: Float, dark: bool, floor: float, counts: Float) -> None:
    """Count what the pairs of neighbouring cells show; dark: of the first cell beyond the line."""
    counts[:] = 0.0
    count = len(profile)
    used = np.zeros(count, dtype=np.bool_)
    run = 0
    for j in range(count - 1):
        # Positive where the colours are the expected ones.
        sign = -1.0 if dark == (j % 2 == 0) else 1.0
        contrast = _contrast(profile, sign, j, floor)
        outer = sign * (_over(profile, j, _OUTER) - _over(profile, j + 1, _OUTER)) / contrast
        margin = -sign * (_over(profile, j, _MARGIN) - _over(profile, j + 1, _MARGIN)) / contrast
        if outer >= _ALTERNATES and abs(margin) <= _EVEN:
            run += 1
            counts[_ENDS] += 1
            counts[_ENDS_RUN] = max(counts[_ENDS_RUN], run)
            used[j] = used[j + 1] = True
        elif not np.isnan(contrast):
            run = 0
        counts[_GOES_ON] += outer >= _ALTERNATES and margin >= _ALTERNATES
        counts[_OVER] += abs(outer) <= _EVEN and abs(margin) <= _EVEN
    _fit_edge(profile, used, counts)


@kernel_part
def _over(profile: Float, j: int, part: tuple[int, int]) -> float:
    return float(np.mean(profile[j, part[0] : part[1]]))


@kernel_part
def _contrast(profile: Float, sign: float, j: int, floor: float) -> float:
    """Mean difference of the checkers within near cells j and j + 1; NaN where there is none."""
    total, count = 0.0, 0
    for k in range(max(0, j - 2), min(len(profile) - 1, j + 3)):
        other = sign if (k - j) % 2 == 0 else -sign
        difference = -other * (profile[k, 0] - profile[k + 1, 0])
        if difference >= floor:
            total += difference
            count += 1
        elif k == j:
            return np.nan
    return total / count


@kernel_part
def _fit_edge(profile: Float, used: NDArray[np.bool_], counts: Float) -> None:
    """Where the outermost checkers end: mean depth, its drift along the line, its scatter."""
    count = len(profile)
    sums = np.zeros(6)
    level_total, level_count = 0.0, 0
    for j in range(count):
        if not used[j]:
            continue
        outer, margin = _over(profile, j, _OUTER), _over(profile, j, _MARGIN)
        contrast = abs(profile[j, 0] - outer)
        low = min(profile[j, 0], outer)
        if not contrast > 0:
            continue
        level_total += (margin - low) / contrast
        level_count += 1
        if not abs(outer - margin) >= _EDGE_CONTRAST * contrast:
            continue
        # The area under the profile from half a cell to one and a half; blur does not move it.
        area = 0.0
        for k in range(1, 13):
            share = (profile[j, k + 1] - margin) / (outer - margin)
            weight = 0.5 if k in (1, 12) else 1.0
            area += weight * min(max(share, -0.5), 1.5)
        depth = _FIRST_DEPTH + _DEPTH_STEP + _DEPTH_STEP * area
        sums += np.array([1.0, j, depth, j * j, j * depth, depth * depth])
    counts[_LEVEL] = level_total / level_count if level_count else np.nan
    counts[_EDGES] = sums[0]
    if sums[0] < 1:
        return
    mean_j, mean = sums[1] / sums[0], sums[2] / sums[0]
    spread = sums[3] / sums[0] - mean_j**2
    slope = (sums[4] / sums[0] - mean_j * mean) / spread if spread > 0.5 else 0.0
    counts[_MEAN] = mean
    # Between the ends of a run with this spread.
    counts[_SLOPE] = slope * np.sqrt(12 * spread)
    counts[_SCATTER] = np.sqrt(max(sums[5] / sums[0] - mean**2 - slope**2 * spread, 0.0))
