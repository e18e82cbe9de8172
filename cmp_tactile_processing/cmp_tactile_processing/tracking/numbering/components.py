"""Numbers of corners from how gridlines connect them: gridline pointers (paper, III.B)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.tracking.detector import Component, CornerGraph

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
