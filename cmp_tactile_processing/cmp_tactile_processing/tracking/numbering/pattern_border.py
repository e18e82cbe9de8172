"""Where the pattern ends: what lies beyond the outermost corners that are connected."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve, map_coordinates

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
    found = []
    for lines, dark, length in sides:
        profile = _profiles(picture, lines)
        counts = _count(profile, dark, floor)
        found.append(_side(counts, max(length, lines.shape[1]) - 2))
    return found


@dataclass(frozen=True)
class _Counts:
    """What is counted of a side.

    Pairs of neighbouring cells: ends, where the pattern ends; ends_run, the most of these in a
    row; goes_on, where there are further checkers; over, where there are none even within.
    level: of the margin.  depth (n, 2): cells, and how far out in cells their checkers end.
    """

    ends: int
    ends_run: int
    goes_on: int
    over: int
    level: float
    depth: Float

    def has_edge(self, least: float) -> bool:
        """Whether so many checkers end one cell out, along the line, with little scatter."""
        if len(self.depth) < least:
            return False
        cell, depth = self.depth.T
        mean, spread = depth.mean(), cell.var()
        slope = np.mean((cell - cell.mean()) * (depth - mean)) / spread if spread > 0.5 else 0.0
        scatter = np.sqrt(max(depth.var() - slope**2 * spread, 0.0))
        # Between the ends of a run with this spread.
        aslant = abs(slope) * np.sqrt(12 * spread)
        return bool(abs(mean - 1) <= EDGE_OFF and aslant <= EDGE_ASLANT and scatter <= EDGE_SCATTER)


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


def _profiles(picture: NDArray[np.float32] | NDArray[np.uint8], lines: Float) -> Float:
    """Grey levels (m - 1, 16) within and beyond the cells of the outermost of lines (3, m, 2)."""
    step = lines[0] - lines[1]
    outwards = _mean_around(step, 1)
    bend = np.nan_to_num(_mean_around(step - (lines[1] - lines[2]), 3))
    depth = np.array([*_WITHIN, *(_FIRST_DEPTH + _DEPTH_STEP * np.arange(_DEPTHS))])[:, None, None]
    line = lines[0] + depth * outwards + 0.5 * depth * (depth + 1) * bend
    share = np.array(_ACROSS)[:, None, None, None]
    x, y = np.moveaxis((1.0 - share) * line[:, :-1] + share * line[:, 1:], -1, 0)
    # Where nothing is known: outside.
    places = np.nan_to_num([y, x], nan=-1.0)
    grey = map_coordinates(picture, places, output=np.float64, order=1, cval=np.nan).mean(axis=0)
    within = grey[: len(_WITHIN)].mean(axis=0)
    return np.concatenate([within[:, None], grey[len(_WITHIN) :].T], axis=1)


def _mean_around(values: Float, reach: int) -> Float:
    """Mean of the known ones of values (m, 2) up to so many places away; NaN where none is."""
    known = np.isfinite(values)
    around = np.ones((2 * reach + 1, 1))
    total = convolve(np.where(known, values, 0.0), around, mode="constant")
    count = convolve(known.astype(np.float64), around, mode="constant")
    return np.asarray(total / np.where(count > 0, count, np.nan))


def _count(profile: Float, dark: bool, floor: float) -> _Counts:
    """What the pairs of neighbouring cells show; dark: of the first cell beyond the line."""
    # Positive where the colours are the expected ones.
    sign = np.where(np.arange(len(profile) - 1) % 2 == 0, -1.0, 1.0) * (1.0 if dark else -1.0)
    contrast = _contrasts(profile, sign, floor)
    outer = sign * -np.diff(_over(profile, _OUTER)) / contrast
    margin = sign * np.diff(_over(profile, _MARGIN)) / contrast
    ends = (outer >= _ALTERNATES) & (np.abs(margin) <= _EVEN)
    used = np.zeros(len(profile), dtype=np.bool_)
    used[:-1] |= ends
    used[1:] |= ends
    level, depth = _edge(profile, used)
    return _Counts(
        ends=int(np.count_nonzero(ends)),
        ends_run=_longest_run(ends[np.isfinite(contrast)]),
        goes_on=int(np.count_nonzero((outer >= _ALTERNATES) & (margin >= _ALTERNATES))),
        over=int(np.count_nonzero((np.abs(outer) <= _EVEN) & (np.abs(margin) <= _EVEN))),
        level=level,
        depth=depth,
    )


def _longest_run(mask: NDArray[np.bool_]) -> int:
    places = np.flatnonzero(np.concatenate([[True], ~mask, [True]]))
    return int(np.diff(places).max()) - 1


def _over(profile: Float, part: tuple[int, int]) -> Float:
    return np.asarray(profile[:, part[0] : part[1]].mean(axis=1))


def _contrasts(profile: Float, sign: Float, floor: float) -> Float:
    """Mean difference of the checkers within near each pair of cells; NaN where there is none."""
    difference = sign * np.diff(profile[:, 0])
    enough = difference >= floor
    around = np.ones(5)
    total = convolve(np.where(enough, difference, 0.0), around, mode="constant")
    count = convolve(enough.astype(np.float64), around, mode="constant")
    return np.asarray(np.where(enough, total, np.nan) / np.maximum(count, 1))


def _edge(profile: Float, used: NDArray[np.bool_]) -> tuple[float, Float]:
    """The margin's level, and where (n, 2) the outermost checkers end: cell, depth in cells."""
    cell = np.flatnonzero(used)
    inner, outer = profile[cell, 0], _over(profile[cell], _OUTER)
    margin = _over(profile[cell], _MARGIN)
    contrast = np.abs(inner - outer)
    differs = contrast > 0
    level = (margin - np.minimum(inner, outer))[differs] / contrast[differs]
    sharp = differs & (np.abs(outer - margin) >= _EDGE_CONTRAST * contrast)
    within = (profile[cell][sharp, 2:14] - margin[sharp, None]) / (outer - margin)[sharp, None]
    # The area under the profile from half a cell to one and a half; blur does not move it.
    weight = np.array([0.5, *[1.0] * 10, 0.5])
    area = np.clip(within, -0.5, 1.5) @ weight
    depth = _FIRST_DEPTH + _DEPTH_STEP + _DEPTH_STEP * area
    mean_level = float(level.mean()) if len(level) else float("nan")
    return mean_level, np.stack([cell[sharp], depth], axis=1)
