"""Gridline pointers: the number of every corner from the connectivity alone (paper, III.B)."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from cmp_tactile_processing.corner_graph import STEPS, CornerGraph, Island

__all__ = ["drop_strained", "traverse"]


# Between neighbouring corners the gel stretches, shears and turns by less than this share of their
# distance; beyond it another pattern or a false outline is seen.
LARGEST_STRAIN = 0.6


def drop_strained(
    graph: CornerGraph, row_step: NDArray[np.float64], col_step: NDArray[np.float64]
) -> CornerGraph:
    """The graph without pointers that differ from the pattern at rest more than a gel can strain.

    row_step, col_step (n, 2): px from each corner to the next along i and along j at rest.
    """
    neighbour = graph.neighbour.copy()
    for towards, (di, dj) in enumerate(STEPS):
        at_rest = di * row_step + dj * col_step
        other = neighbour[:, towards]
        change = np.linalg.norm(graph.position[other] - graph.position - at_rest, axis=1)
        false = (other >= 0) & (change > LARGEST_STRAIN * np.linalg.norm(at_rest, axis=1))
        back = other[false]
        neighbour[back, (towards + 2) % 4] = -1
        neighbour[false, towards] = -1
    return replace(graph, neighbour=neighbour)


def traverse(graph: CornerGraph) -> list[Island]:
    """Point organisation: walk the pointers and number each connected set, largest first.

    A false pointer shifts the numbers of all that is reached through it.  So pointers around a
    square that does not close count for nothing, corners that two ways give two numbers are left
    out, and what hangs together only through them becomes several sets.
    """
    graph = replace(graph, neighbour=_without_open_squares(graph))
    number = np.zeros((len(graph.position), 2), dtype=np.intp)
    seen = np.zeros(len(graph.position), dtype=bool)
    pointers, steps = graph.neighbour.tolist(), STEPS.tolist()
    islands = []
    for start in np.flatnonzero(graph.merged).tolist():
        if seen[start]:
            continue
        members, places = _walk(start, pointers, steps, graph.merged, seen)
        number[members] = places
        keep = np.array(members)[~_contradicted(members, number, graph)]
        islands += [
            Island(graph.position[part], number[part], graph.even[part])
            for part in _connected(keep, graph)
        ]
    return sorted(islands, key=lambda island: len(island.position), reverse=True)


def _without_open_squares(graph: CornerGraph) -> NDArray[np.intp]:
    """Pointers (n, 4) less those of squares that do not close: one of their sides is false."""
    inner = np.append(graph.merged, False)
    pointers = np.concatenate([graph.neighbour, np.full((1, 4), -1)])
    pointers[~inner[pointers]] = -1
    kept: NDArray[np.intp] = graph.neighbour.copy()
    for first in range(4):
        for second in ((first + 1) % 4, (first + 3) % 4):
            one, other = pointers[:-1, first], pointers[:-1, second]
            far, same = pointers[one, second], pointers[other, first]
            here = np.flatnonzero((far >= 0) & (same >= 0) & (far != same))
            kept[here, first] = kept[one[here], (first + 2) % 4] = -1
            kept[one[here], second] = kept[far[here], (second + 2) % 4] = -1
    return kept


def _walk(
    start: int,
    pointers: list[list[int]],
    steps: list[list[int]],
    inner: NDArray[np.bool_],
    seen: NDArray[np.bool_],
) -> tuple[list[int], list[tuple[int, int]]]:
    members, places = [start], [(0, 0)]
    seen[start] = True
    queue = deque([(start, 0, 0)])
    while queue:
        node, i, j = queue.popleft()
        for other, (di, dj) in zip(pointers[node], steps, strict=True):
            if other >= 0 and inner[other] and not seen[other]:
                seen[other] = True
                members.append(other)
                places.append((i + di, j + dj))
                queue.append((other, i + di, j + dj))
    return members, places


def _connected(members: NDArray[np.intp], graph: CornerGraph) -> list[NDArray[np.intp]]:
    """The members in parts that hang together by pointers between members alone."""
    index = np.full(len(graph.position), -1, dtype=np.intp)
    index[members] = np.arange(len(members))
    other = graph.neighbour[members]
    other = np.where(other >= 0, index[other], -1)
    here, towards = np.nonzero(other >= 0)
    links = coo_array(
        (np.ones(len(here)), (here, other[here, towards])), shape=(len(members), len(members))
    )
    count, label = connected_components(links, directed=False)
    return [members[label == part] for part in range(count)]


def _contradicted(
    members: list[int], number: NDArray[np.intp], graph: CornerGraph
) -> NDArray[np.bool_]:
    """Members whose number clashes with a neighbour's, with another's, or with their parity."""
    index = np.array(members)
    doubtful = np.zeros(len(index), dtype=bool)
    for towards, step in enumerate(STEPS):
        other = graph.neighbour[index, towards]
        linked = (other >= 0) & graph.merged[np.maximum(other, 0)]
        doubtful |= linked & (number[other] != number[index] + step).any(axis=1)
    _, inverse, counts = np.unique(number[index], axis=0, return_inverse=True, return_counts=True)
    doubtful |= counts[inverse.ravel()] > 1
    parity = (number[index].sum(axis=1) % 2 == 0) == graph.even[index]
    return np.asarray(doubtful | (parity != (np.mean(parity) > 0.5)))
