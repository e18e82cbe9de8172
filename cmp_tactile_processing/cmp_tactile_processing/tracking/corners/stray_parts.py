"""Measured corners whose displacement does not continue that of the rest: another pattern's.

Detected corners show a seam between two patterns where the gridlines jump.  Where they happen to
meet evenly only sub-pixel corners show it: a gel's displacement bends little from corner to corner.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

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
# A part needs so many corners for each square checker of the gap: a surface bends to fit a few.
CORNERS_OF_GAP = 2
# Corners of the parts that far from one another, beyond the gap, count.
REACH = 3
# A single corner lies within this of the surface through those around it, in sides, or within so
# many times the median second difference: at the grid's own corners a scatter counts most.
LARGEST_STEP, USUAL_STEPS = 0.07, 3.0
# A stray part within the pattern belongs to it where so many of the corners around it are there.
CONTINUOUS = 0.5
# Fewer corners around it say nothing about a part, or of a single corner.
FEWEST_AROUND, FEWEST_AROUND_SINGLE = 8, 6
# Keeps the second order small where too few corners determine it.
STIFFNESS = 1e-3


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
    stray = _set_apart(known & ~_continued(displacement, known, bent, usual), known)
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


def _set_apart(stray: Mask, known: Mask) -> Mask:
    """The stray corners that come in from outside, or that missing ones set apart from the rest.

    A seam destroys corners along it; where it does not, within the pattern, the gel is dragged.
    """
    label = cv2.connectedComponents(stray.astype(np.uint8), connectivity=8)[1]
    within = np.zeros_like(stray)
    within[1:-1, 1:-1] = True
    apart: Mask = stray.copy()
    for number in range(1, label.max() + 1):
        part: Mask = label == number
        around = (_distance(part) <= 1) & ~part
        if within[part].all() and np.mean(known[around]) > CONTINUOUS:
            apart[part] = False
    return apart


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
    too_few = np.count_nonzero(part) < CORNERS_OF_GAP * gap**2
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
