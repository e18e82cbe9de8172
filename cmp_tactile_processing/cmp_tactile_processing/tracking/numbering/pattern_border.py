"""Where the pattern ends: what lies beyond the outermost corners that are connected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

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
# The edge of the outermost checkers lies one cell out.  Largest error of its mean (corners are
# known to a pixel or two), of its slope, and its scatter; in cells.
MAX_EDGE_OFFSET_CELLS = 0.35
MAX_EDGE_SLOPE_CELLS = 0.5
MAX_EDGE_SCATTER_CELLS = 0.25

# Grey levels per cell along the outermost line: of the checker within, then of this profile
# outwards; depths in cells from the line.
_FIRST_DEPTH, _DEPTH_STEP, _DEPTHS = 0.35, 0.1, 15
_DEPTH = np.array([-0.65, -0.5, -0.35, *(_FIRST_DEPTH + _DEPTH_STEP * np.arange(_DEPTHS))])
_ACROSS = (0.3, 0.5, 0.7)
# Samples of the profile that lie on the outermost checkers and on the margin.
_OUTER, _MARGIN = (1, 5), (11, 15)
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
    picture = image.smooth if step >= SMOOTHED_FROM_PX else image.grey.astype(np.float32)
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
    found = []
    for lines, dark, length in sides:
        outermost = np.ascontiguousarray(lines)
        profile = np.empty((lines.shape[1] - 1, len(_DEPTH) - 2))
        _set_profile(picture, outermost, np.empty((2, lines.shape[1], 2)), profile)
        counts = _Counts(*_count(profile, bool(dark), floor))
        found.append(_side(counts, max(length, lines.shape[1]) - 2))
    return found


class _Counts(NamedTuple):
    """What is counted of a side.

    Pairs of neighbouring cells: ends, where the pattern ends; ends_run, the most of these in a
    row; goes_on, where there are further checkers; over, where there are none even within.
    level: of the margin.  edges: cells whose checkers end beyond the line; how far out in cells:
    mean, aslant from end to end, scatter.
    """

    ends: int
    ends_run: int
    goes_on: int
    over: int
    level: float
    edges: int
    mean: float
    aslant: float
    scatter: float

    def has_edge(self, least: float) -> bool:
        """Whether so many checkers end one cell out, along the line, with little scatter."""
        near = abs(self.mean - 1) <= MAX_EDGE_OFFSET_CELLS
        along = self.aslant <= MAX_EDGE_SLOPE_CELLS and self.scatter <= MAX_EDGE_SCATTER_CELLS
        return self.edges >= least and near and along


def _side(counts: _Counts, pairs: int) -> BorderSide:
    """The side by what was counted; pairs: of neighbouring cells along the whole line."""
    need = max(np.ceil(LEAST_SHARE * pairs), min(2, pairs))
    edge = counts.has_edge(max(need // 2, 1))
    ends = bool(edge and counts.ends >= need and counts.ends_run >= min(LEAST_RUN, need))
    return BorderSide(
        ends=ends,
        firm=ends and counts.ends >= FIRM_SHARE * pairs,
        goes_on=bool(counts.goes_on >= need),
        over=bool(counts.over >= need),
        level=counts.level,
    )


@kernel
def _set_profile(picture: NDArray[np.float32], lines: Float, ways: Float, profile: Float) -> None:
    """Grey levels (m - 1, 16) within and beyond the cells of the outermost of lines (3, m, 2).

    ways (2, m, 2): scratch.
    """
    m = lines.shape[1]
    outwards, bend = ways
    for k in range(m):
        for axis in range(2):
            first = lines[:, :, axis]
            outwards[k, axis] = _mean_around(first, k, 1, False)
            bent = _mean_around(first, k, 3, True)
            bend[k, axis] = bent if np.isfinite(bent) else 0.0
    profile[:] = 0.0
    for cell in range(m - 1):
        for number in range(len(_DEPTH)):
            depth = _DEPTH[number]
            curved = 0.5 * depth * (depth + 1)
            total = 0.0
            for share in _ACROSS:
                x = y = 0.0
                for k, part in ((cell, 1 - share), (cell + 1, share)):
                    x += part * (lines[0, k, 0] + depth * outwards[k, 0] + curved * bend[k, 0])
                    y += part * (lines[0, k, 1] + depth * outwards[k, 1] + curved * bend[k, 1])
                total += _grey_at(picture, x, y)
            # The first three are the checker within.
            profile[cell, max(number - 2, 0)] += total / (9 if number < 3 else 3)


@kernel_part
def _mean_around(lines: Float, place: int, reach: int, bends: bool) -> float:
    """Mean of the known steps from one line to the next one out, or of how much longer these are
    than those before, up to so many places away; NaN where none is.  lines (3, m).
    """
    total, count = 0.0, 0
    for k in range(max(place - reach, 0), min(place + reach + 1, lines.shape[1])):
        value = lines[0, k] - lines[1, k]
        if bends:
            value -= lines[1, k] - lines[2, k]
        if np.isfinite(value):
            total += value
            count += 1
    return total / count if count > 0 else np.nan


@kernel_part
def _grey_at(picture: NDArray[np.float32], x: float, y: float) -> float:
    """Bilinear; NaN outside the picture, and where the place is not known."""
    height, width = picture.shape
    if not (0 <= x <= width - 1 and 0 <= y <= height - 1):
        return np.nan
    j, i = min(int(x), width - 2), min(int(y), height - 2)
    u, v = x - j, y - i
    above = (1 - u) * picture[i, j] + u * picture[i, j + 1]
    below = (1 - u) * picture[i + 1, j] + u * picture[i + 1, j + 1]
    return float((1 - v) * above + v * below)


@kernel
def _count(
    profile: Float, dark: bool, floor: float
) -> tuple[int, int, int, int, float, int, float, float, float]:
    """`_Counts` of the pairs of neighbouring cells; dark: of the first cell beyond the line."""
    pairs = len(profile) - 1
    used = np.zeros(len(profile), np.bool_)
    ends = ends_run = run = goes_on = over = 0
    for k in range(pairs):
        sign = _expected_sign(k, dark)
        contrast = _contrast(profile, k, dark, floor)
        if np.isnan(contrast):
            continue
        outer = sign * (_over(profile, k, _OUTER) - _over(profile, k + 1, _OUTER)) / contrast
        margin = sign * (_over(profile, k + 1, _MARGIN) - _over(profile, k, _MARGIN)) / contrast
        run += 1
        if outer >= _ALTERNATES and abs(margin) <= _EVEN:
            ends += 1
            used[k] = used[k + 1] = True
        else:
            run = 0
        ends_run = max(ends_run, run)
        goes_on += outer >= _ALTERNATES and margin >= _ALTERNATES
        over += abs(outer) <= _EVEN and abs(margin) <= _EVEN
    return (ends, ends_run, goes_on, over, *_edge(profile, used))


@kernel_part
def _expected_sign(pair: int, dark: bool) -> float:
    """Of the second checker within less the first; dark: of the first cell beyond the line."""
    return 1.0 if (pair % 2 == 1) == dark else -1.0


@kernel_part
def _over(profile: Float, cell: int, part: tuple[int, int]) -> float:
    total = 0.0
    for k in range(part[0], part[1]):
        total += profile[cell, k]
    return total / (part[1] - part[0])


@kernel_part
def _contrast(profile: Float, pair: int, dark: bool, floor: float) -> float:
    """Mean difference of the checkers within near a pair of cells; NaN where there is none."""
    total, count, own = 0.0, 0, False
    for k in range(max(pair - 2, 0), min(pair + 3, len(profile) - 1)):
        difference = _expected_sign(k, dark) * (profile[k + 1, 0] - profile[k, 0])
        if difference >= floor:
            total += difference
            count += 1
            own |= k == pair
    return total / count if own else np.nan


@kernel_part
def _edge(profile: Float, used: NDArray[np.bool_]) -> tuple[float, int, float, float, float]:
    """The margin's level, then where the outermost checkers of the used cells end: how many, mean,
    aslant, scatter, in cells.
    """
    levels = level = 0.0
    n = a = b = aa = bb = ab = 0.0
    for cell in range(len(profile)):
        inner, outer = profile[cell, 0], _over(profile, cell, _OUTER)
        margin = _over(profile, cell, _MARGIN)
        contrast = abs(inner - outer)
        if not (used[cell] and contrast > 0):
            continue
        levels += 1
        level += (margin - min(inner, outer)) / contrast
        if not abs(outer - margin) >= _EDGE_CONTRAST * contrast:
            continue
        # The area under the profile from half a cell to one and a half; blur does not move it.
        area = 0.0
        for k in range(2, 14):
            within = min(max((profile[cell, k] - margin) / (outer - margin), -0.5), 1.5)
            area += within * (0.5 if k in (2, 13) else 1.0)
        depth = _FIRST_DEPTH + _DEPTH_STEP + _DEPTH_STEP * area
        n, a, b = n + 1, a + cell, b + depth
        aa, bb, ab = aa + cell * cell, bb + depth * depth, ab + cell * depth
    level = level / levels if levels > 0 else np.nan
    if n == 0:
        return level, 0, np.nan, np.nan, np.nan
    spread = aa / n - (a / n) ** 2
    slope = (ab / n - a / n * b / n) / spread if spread > 0.5 else 0.0
    scatter = np.sqrt(max(bb / n - (b / n) ** 2 - slope**2 * spread, 0.0))
    # Between the ends of a run with this spread.
    return level, int(n), b / n, abs(slope) * np.sqrt(12 * spread), scatter
