"""Numbers of corners from how gridlines connect them: gridline pointers (paper, III.B)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.measured import GridFault
from cmp_tactile_processing.tracking.detector import Component, CornerGraph, NominalGrid

Whole = NDArray[np.int64]
# Between neighbouring corners the gel stretches, shears and turns by less than this share of their
# distance; beyond it another pattern or a false outline is seen.
LARGEST_STRAIN = 0.45
# The steps in (i, j) of `corner_graph.STEPS`, as constants for the compiled walk.
_DI = (-1, 0, 1, 0)
_DJ = (0, 1, 0, -1)
# What the walk knows of a corner: its number (i, j) and its set.
_I, _J, _SET = 0, 1, 2
_NEW, _LEFT_OUT, _NUMBERED = -2, -1, 0
# Fewer corners that the fit cannot join to the rest are the rim of something that hides the gel.
FEWEST_STRAYS = 6

Float = NDArray[np.float64]
Index = NDArray[np.intp]
# Places that are tried: around the one that the nearest known displacement suggests.
REACH = 4
# How fast the displacement changes from a corner to the next, and how much of it no plane follows,
# in sides: it goes on across a gap as a plane whose slope is held back accordingly.
SLOPE, ROUGHNESS = 0.1, 0.15
# The best place fits within this and leads by this; few corners must fit better, in sides.
FIT, LEAD = 0.45, 0.6
FEW, FIT_OF_FEW, GAP_OF_FEW = 6, 0.3, 3.0
# Distances between numbered corners of a line, as shares of the nominal ones.
NEAREST, FARTHEST = 0.4, 1.6

# A corner lies within this share of a side, and what detected corners are off by in px, of where
# its neighbours put it.
LARGEST_MISFIT, DETECTED_PX = 0.3, 1.5


class GridlinePointers:
    """Follows the pointers of one graph after the other; keeps its buffers.

    Time is linear in the number of corners.
    """

    def __init__(self) -> None:
        self._room = 0
        self._reserve(1024)

    def components(
        self,
        graph: CornerGraph,
        row_step: NDArray[np.float64],
        col_step: NDArray[np.float64],
        fewest: int = 1,
    ) -> list[Component]:
        """`traverse` of the graph without strained pointers; steps as in `drop_strained`.

        fewest: corners of the smallest set that is returned.
        """
        pointers = self._believed(graph)
        _drop_strained(graph.position, row_step, col_step, pointers)
        return self._traversed(graph, pointers, fewest)

    def unstrained_components(self, graph: CornerGraph) -> list[Component]:
        """`traverse`, with every pointer believed whatever its length and direction."""
        return self._traversed(graph, self._believed(graph), 1)

    def _reserve(self, count: int) -> None:
        if count <= self._room:
            return
        self._room = 2 * count
        self._pointers = np.empty((2, self._room, 4), dtype=np.int64)
        self._walked = np.empty((self._room, 3), dtype=np.int64)
        self._order = np.empty(self._room, dtype=np.int64)
        self._begin = np.empty(self._room + 1, dtype=np.int64)
        # A power of two, at most a quarter full: a hash table of the numbers that are given.
        self._slots = np.full(1 << int(np.ceil(np.log2(4 * self._room))), -1, dtype=np.int64)

    def _believed(self, graph: CornerGraph) -> Whole:
        self._reserve(len(graph.position))
        pointers = self._pointers[0, : len(graph.position)]
        _answered_pointers(graph.neighbour, graph.merged, pointers)
        return pointers

    def _traversed(self, graph: CornerGraph, pointers: Whole, fewest: int) -> list[Component]:
        count = len(pointers)
        kept, walked = self._pointers[1, :count], self._walked[:count]
        _drop_open_squares(pointers, kept)
        walked[:, _SET] = np.where(graph.merged, _NEW, _LEFT_OUT)
        _number_sets(kept, graph.even, walked, self._order, self._slots)
        parts = _connected_parts(kept, walked, self._order, self._begin)
        components = []
        size = np.diff(self._begin[: parts + 1])
        for part in np.argsort(-size, kind="stable")[: np.count_nonzero(size >= fewest)]:
            members = self._order[self._begin[part] : self._begin[part + 1]]
            number = walked[members, :_SET]
            components.append(Component(graph.position[members], number, graph.even[members]))
        return components


def drop_strained(
    graph: CornerGraph, row_step: NDArray[np.float64], col_step: NDArray[np.float64]
) -> CornerGraph:
    """The graph without pointers that differ from the pattern at rest more than a gel can strain.

    row_step, col_step (n, 2): px from each corner to the next along i and along j at rest.
    """
    neighbour = np.array(graph.neighbour, dtype=np.int64)
    _drop_strained(graph.position, row_step, col_step, neighbour)
    return replace(graph, neighbour=neighbour)


def traverse(graph: CornerGraph) -> list[Component]:
    """Point organisation: walk the pointers and number each connected set, largest first.

    A false pointer shifts the numbers of all that is reached through it.  So pointers that are not
    answered and pointers around a square that does not close count for nothing, corners that two
    ways give two numbers are left out, and what hangs together only through them becomes several
    sets.
    """
    return GridlinePointers().unstrained_components(graph)


@kernel
def _answered_pointers(neighbour: Whole, inner: NDArray[np.bool_], pointers: Whole) -> None:
    """Pointers between inner corners of which either end points at the other."""
    for node in range(len(neighbour)):
        for towards in range(4):
            other = neighbour[node, towards]
            answered = (
                other >= 0
                and inner[node]
                and inner[other]
                and neighbour[other, (towards + 2) % 4] == node
            )
            pointers[node, towards] = other if answered else -1


@kernel
def _drop_strained(
    position: NDArray[np.float64],
    row_step: NDArray[np.float64],
    col_step: NDArray[np.float64],
    pointers: Whole,
) -> None:
    for node in range(len(pointers)):
        for towards in range(4):
            other = pointers[node, towards]
            if other < 0:
                continue
            x = _DI[towards] * row_step[node, 0] + _DJ[towards] * col_step[node, 0]
            y = _DI[towards] * row_step[node, 1] + _DJ[towards] * col_step[node, 1]
            dx = position[other, 0] - position[node, 0] - x
            dy = position[other, 1] - position[node, 1] - y
            if not dx * dx + dy * dy <= LARGEST_STRAIN**2 * (x * x + y * y):
                pointers[node, towards] = -1
                if pointers[other, (towards + 2) % 4] == node:
                    pointers[other, (towards + 2) % 4] = -1


@kernel
def _drop_open_squares(pointers: Whole, kept: Whole) -> None:
    """`kept`: the pointers less those of squares that do not close: one of their sides is false."""
    for node in range(len(pointers)):
        for towards in range(4):
            kept[node, towards] = pointers[node, towards]
    for node in range(len(pointers)):
        for first in range(4):
            second = (first + 1) % 4
            one, other = pointers[node, first], pointers[node, second]
            if one < 0 or other < 0:
                continue
            far, same = pointers[one, second], pointers[other, first]
            if far < 0 or same < 0 or far == same:
                continue
            kept[node, first] = kept[one, (first + 2) % 4] = -1
            kept[node, second] = kept[other, (second + 2) % 4] = -1
            kept[one, second] = kept[far, (second + 2) % 4] = -1
            kept[other, first] = kept[same, (first + 2) % 4] = -1


@kernel
def _number_sets(
    kept: Whole, even: NDArray[np.bool_], walked: Whole, queue: Whole, slots: Whole
) -> None:
    """Number each connected set from its first corner and leave out what is contradicted."""
    for start in range(len(kept)):
        if walked[start, _SET] == _NEW:
            members = queue[: _walk(kept, walked, queue, start)]
            _leave_out_contradicted(kept, walked, members)
            _leave_out_minority(even, walked, members)
            _leave_out_twins(walked, members, slots)


@kernel_part
def _walk(kept: Whole, walked: Whole, queue: Whole, start: int) -> int:
    walked[start, _I] = walked[start, _J] = 0
    walked[start, _SET] = _NUMBERED
    queue[0] = start
    head, tail = 0, 1
    while head < tail:
        node = queue[head]
        head += 1
        for towards in range(4):
            other = kept[node, towards]
            if other >= 0 and walked[other, _SET] == _NEW:
                walked[other, _I] = walked[node, _I] + _DI[towards]
                walked[other, _J] = walked[node, _J] + _DJ[towards]
                walked[other, _SET] = _NUMBERED
                queue[tail] = other
                tail += 1
    return tail


@kernel_part
def _leave_out_contradicted(kept: Whole, walked: Whole, members: Whole) -> None:
    """Members whose number clashes with a neighbour's."""
    for node in members:
        for towards in range(4):
            other = kept[node, towards]
            if other >= 0 and (
                walked[other, _I] != walked[node, _I] + _DI[towards]
                or walked[other, _J] != walked[node, _J] + _DJ[towards]
            ):
                walked[node, _SET] = _LEFT_OUT


@kernel_part
def _leave_out_minority(even: NDArray[np.bool_], walked: Whole, members: Whole) -> None:
    """Members whose colours clash with their number, as most others' do not."""
    agreeing = 0
    for node in members:
        agreeing += ((walked[node, _I] + walked[node, _J]) % 2 == 0) == even[node]
    majority = 2 * agreeing > len(members)
    for node in members:
        if (((walked[node, _I] + walked[node, _J]) % 2 == 0) == even[node]) != majority:
            walked[node, _SET] = _LEFT_OUT


@kernel_part
def _leave_out_twins(walked: Whole, members: Whole, slots: Whole) -> None:
    """Members that bear the same number as another."""
    mask = len(slots) - 1
    for node in members:
        slot = (walked[node, _I] * 73856093 ^ walked[node, _J] * 19349663) & mask
        while slots[slot] >= 0:
            other = slots[slot]
            if walked[other, _I] == walked[node, _I] and walked[other, _J] == walked[node, _J]:
                walked[node, _SET] = walked[other, _SET] = _LEFT_OUT
                break
            slot = (slot + 1) & mask
        if slots[slot] < 0:
            slots[slot] = node
    # Emptied for the next set; an entry lies in the run of slots that starts at its hash.
    for node in members:
        slot = (walked[node, _I] * 73856093 ^ walked[node, _J] * 19349663) & mask
        while slots[slot] >= 0:
            slots[slot] = -1
            slot = (slot + 1) & mask


@kernel
def _connected_parts(kept: Whole, walked: Whole, order: Whole, begin: Whole) -> int:
    """Numbered corners in parts that hang together: order[begin[p]:begin[p + 1]]; their count."""
    tail = parts = 0
    begin[0] = 0
    for start in range(len(kept)):
        if walked[start, _SET] != _NUMBERED:
            continue
        parts += 1
        walked[start, _SET] = parts
        order[tail] = start
        head = tail
        tail += 1
        while head < tail:
            node = order[head]
            head += 1
            for towards in range(4):
                other = kept[node, towards]
                if other >= 0 and walked[other, _SET] == _NUMBERED:
                    walked[other, _SET] = parts
                    order[tail] = other
                    tail += 1
        begin[parts] = tail
    return parts


# Numbers of further components of corners, from those whose numbers are known.


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
    few = len(number) < FEW
    gap = np.abs(known[:, None] - number).sum(axis=-1).min()
    if misfit > (FIT_OF_FEW if few else FIT) or (few and gap > GAP_OF_FEW):
        return None
    if len(best) > 1 and best[1][0] - misfit < LEAD:
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
                if not NEAREST * length <= along <= FARTHEST * length:
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
    normal[1, 1] += weight.max() * (ROUGHNESS / SLOPE) ** 2
    normal[2, 2] += weight.max() * (ROUGHNESS / SLOPE) ** 2
    plane = np.linalg.solve(normal, (terms * weight[:, None]).T @ displacement)
    at_rest = nominal.corners[number[:, 0], number[:, 1]]
    expected = at_rest + plane[0] + (number - centre) @ plane[1:]
    return float(np.sqrt(((component.position - expected) ** 2).sum(axis=1).mean()) / side)


# Numbered corners that lie where their neighbours in the grid do not expect one.


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


@dataclass(frozen=True)
class Numbering:
    """corners (rows, cols, 2) px, NaN where missing; reason, fault: why some are, else empty.

    confidence: 1 for a complete grid that was seen to end on all four sides and fits the nominal
    projection; each missing piece of evidence takes a fixed share.  It orders numberings by their
    evidence and is not a measured probability.  0.5 and less: rows or columns rest on one
    border alone.  0 where nothing is numbered.
    between: the image rows between which the corners lie, px; beyond them the image is torn.
    by_code: whether the pattern's dots show the numbers, wherever it ends.
    """

    corners: NDArray[np.float64]
    reason: str
    fault: GridFault = GridFault.NONE
    confidence: float = 0.0
    between: tuple[float, float] = (-np.inf, np.inf)
    by_code: bool = False

    @classmethod
    def nothing(cls, shape: tuple[int, ...], fault: GridFault, reason: str) -> Numbering:
        """That of a grid (rows, cols) of which no corner has a number."""
        return cls(np.full((*shape, 2), np.nan), reason, fault)


def without_strays(numbering: Numbering, strays: int, missing: int) -> Numbering:
    """What is to be said where so many numbered corners turned out to be another pattern's.

    missing: corners without a position in the end.
    """
    if strays < FEWEST_STRAYS or numbering.fault is GridFault.TWO_PATTERNS:
        return numbering
    reason = (
        f"{missing} corners not seen, and {strays} corners that do not continue the others: "
        "another pattern, or pieces of this one beside an object that hides the rest"
    )
    return replace(numbering, reason=reason, fault=GridFault.TWO_PATTERNS)
