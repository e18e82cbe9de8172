"""Numbers of further components of corners, from those whose numbers are known."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.tracking.detector import Component, NominalGrid

Float = NDArray[np.float64]
Index = NDArray[np.intp]
# Places that are tried: around the one that the nearest known displacement suggests.
REACH = 4
# The displacement continues across a gap as a plane.  Standard deviations of its change from one
# corner to the next, and of what no plane follows, in sides.
SLOPE_STD_SIDES = 0.1
ROUGHNESS_STD_SIDES = 0.15
# Largest misfit of the best place, and smallest lead over the second best, in sides.
MAX_MISFIT_SIDES = 0.45
MIN_LEAD_SIDES = 0.6
# A component with fewer corners than this must fit better, and lie within this gap, in sides.
MIN_CORNERS_USUAL_FIT = 6
MAX_MISFIT_OF_FEW_SIDES = 0.3
MAX_GAP_OF_FEW_SIDES = 3.0
# Distances between numbered corners of a line, as shares of the nominal ones.
MIN_SPACING_RATIO = 0.4
MAX_SPACING_RATIO = 1.6

# A corner lies within this share of a side, and what detected corners are off by in px, of where
# its neighbours put it.
LARGEST_MISFIT, DETECTED_PX = 0.3, 1.5


def joined(
    corners: Float, component: Component, nominal: NominalGrid, even_first: bool
) -> Index | None:
    """What to add to a component's numbers so that it continues the known corners, or None.

    corners (rows, cols, 2) px, NaN where not known; even_first: whether corner (0, 0) is even.
    """
    known = np.argwhere(np.isfinite(corners[..., 0]))
    if not len(known):
        return None
    displacement = (corners - nominal.corners)[known[:, 0], known[:, 1]]
    best: list[tuple[float, Index]] = []
    for shift in _places(component, known, displacement, nominal):
        on_even = int((component.number[0] + shift).sum()) % 2 == 0
        if (bool(component.even[0]) == on_even) != even_first:
            continue
        best.append((_misfit(component, shift, (known, displacement), nominal), shift))
    if not best:
        return None
    best.sort(key=lambda place: place[0])
    misfit, shift = best[0]
    number = component.number + shift
    few = len(number) < MIN_CORNERS_USUAL_FIT
    gap = np.abs(known[:, None] - number).sum(axis=-1).min()
    if misfit > (MAX_MISFIT_OF_FEW_SIDES if few else MAX_MISFIT_SIDES) or (
        few and gap > MAX_GAP_OF_FEW_SIDES
    ):
        return None
    if len(best) > 1 and best[1][0] - misfit < MIN_LEAD_SIDES:
        return None
    if np.isfinite(corners[number[:, 0], number[:, 1], 0]).any():
        return None
    together = corners.copy()
    together[number[:, 0], number[:, 1]] = component.position
    return shift if in_order(together, nominal) else None


def placed(corners: Float, component: Component, shift: Index) -> bool:
    """Whether a component's corners could be added to the known ones: none of theirs is taken.

    corners (rows, cols, 2) px, NaN where not known, are changed; shift (2,): what is to be added to
    the component's numbers.  Those beyond the grid are left out.
    """
    number = component.number + shift
    inside = ((number >= 0) & (number < corners.shape[:2])).all(axis=1)
    i, j = number[inside].T
    if np.isfinite(corners[i, j, 0]).any():
        return False
    corners[i, j] = component.position[inside]
    return True


def in_order(corners: Float, nominal: NominalGrid) -> bool:
    """Whether all corners of a line follow one another at about their nominal distances."""
    along_rows = _in_order(corners, nominal.corners)
    return bool(along_rows and _in_order(corners.swapaxes(0, 1), nominal.corners.swapaxes(0, 1)))


@kernel
def _in_order(corners: Float, nominal: Float) -> bool:
    rows, cols = corners.shape[:2]
    for i in range(rows):
        last = -1
        for j in range(cols):
            if np.isnan(corners[i, j, 0]):
                continue
            if last >= 0:
                along = length = 0.0
                for d in range(2):
                    at_rest = nominal[i, j, d] - nominal[i, last, d]
                    along += (corners[i, j, d] - corners[i, last, d]) * at_rest
                    length += at_rest * at_rest
                if not MIN_SPACING_RATIO * length <= along <= MAX_SPACING_RATIO * length:
                    return False
            last = j
    return True


def _places(
    component: Component, known: Index, displacement: Float, nominal: NominalGrid
) -> list[Index]:
    """Shifts that keep the component on the grid, near the place that its surroundings suggest."""
    size = np.array(nominal.corners.shape[:2])
    low, high = -component.number.min(axis=0), size - 1 - component.number.max(axis=0)
    if (low > high).any():
        return []
    centre = component.position.mean(axis=0)
    seen = nominal.corners[known[:, 0], known[:, 1]] + displacement
    local = displacement[np.argmin(((seen - centre) ** 2).sum(axis=1))]
    nearest = int(nominal.tree.query(centre - local)[1])
    middle = np.rint(component.number.mean(axis=0)).astype(int)
    guess = np.array(divmod(nearest, int(size[1]))) - middle
    first, last = np.maximum(low, guess - REACH), np.minimum(high, guess + REACH)
    return [
        np.array(shift, dtype=np.intp)
        for shift in product(*(range(int(a), int(b) + 1) for a, b in zip(first, last, strict=True)))
    ]


def _misfit(
    component: Component, shift: Index, known: tuple[Index, Float], nominal: NominalGrid
) -> float:
    """RMS distance in sides of the component from where the known displacement goes on to."""
    number = component.number + shift
    place, displacement = known
    centre = number.mean(axis=0)
    offset = place - centre
    away = np.abs(number[:, None] - place).sum(axis=-1).min(axis=0)
    weight = 1 / (1 + away / 2) ** 4
    terms = np.column_stack([np.ones(len(place)), offset])
    side = nominal.side_px
    normal = (terms * weight[:, None]).T @ terms
    normal[1, 1] += weight.max() * (ROUGHNESS_STD_SIDES / SLOPE_STD_SIDES) ** 2
    normal[2, 2] += weight.max() * (ROUGHNESS_STD_SIDES / SLOPE_STD_SIDES) ** 2
    plane = np.linalg.solve(normal, (terms * weight[:, None]).T @ displacement)
    at_rest = nominal.corners[number[:, 0], number[:, 1]]
    expected = at_rest + plane[0] + (number - centre) @ plane[1:]
    return float(np.sqrt(((component.position - expected) ** 2).sum(axis=1).mean()) / side)


def drop_loose_corners(corners: NDArray[np.float64], nominal: NDArray[np.float64]) -> None:
    """Set to NaN in `corners` what most pairs of neighbours contradict.

    corners, nominal (rows, cols, 2) px.  Two neighbours in a line with a corner show where it
    lies, less what the nominal grid bends between them; so does a single neighbour where no pair
    is known, by the nominal step.  A corner without neighbours is dropped.
    """
    loose = np.empty(corners.shape[:2], dtype=np.bool_)
    _find_loose(corners - nominal, nominal, loose)
    corners[loose] = np.nan


@kernel
def _find_loose(
    displacement: NDArray[np.float64], nominal: NDArray[np.float64], loose: NDArray[np.bool_]
) -> None:
    rows, cols = loose.shape
    for i in range(rows):
        for j in range(cols):
            pairs = _votes(displacement, nominal, (i, j), True)
            if pairs[0] + pairs[1] == 0:
                pairs = _votes(displacement, nominal, (i, j), False)
            loose[i, j] = pairs[0] <= pairs[1]


@kernel_part
def _votes(
    displacement: NDArray[np.float64],
    nominal: NDArray[np.float64],
    corner: tuple[int, int],
    in_pairs: bool,
) -> tuple[int, int]:
    """How many pairs of neighbours, or single ones, agree with a corner's place, and disagree."""
    agree = against = 0
    i, j = corner
    rows, cols = displacement.shape[:2]
    for di, dj in ((-1, 0), (0, 1), (1, 0), (0, -1)):
        a, b = i + di, j + dj
        for reach in (2, -1):
            c, d = i + reach * di, j + reach * dj
            # The pair on either side is met once from each of them.
            if reach == -1 and di + dj < 0:
                continue
            if min(a, b) < 0 or a >= rows or b >= cols:
                continue
            if in_pairs and (min(c, d) < 0 or c >= rows or d >= cols):
                continue
            total = length = 0.0
            for axis in range(2):
                expected = displacement[a, b, axis]
                if in_pairs:
                    far = displacement[c, d, axis]
                    expected = 2 * expected - far if reach == 2 else (expected + far) / 2
                total += (displacement[i, j, axis] - expected) ** 2
                length += (nominal[i, j, axis] - nominal[a, b, axis]) ** 2
            if np.isnan(total):
                continue
            if np.sqrt(total) <= LARGEST_MISFIT * np.sqrt(length) + DETECTED_PX:
                agree += 1
            else:
                against += 1
    return agree, against
