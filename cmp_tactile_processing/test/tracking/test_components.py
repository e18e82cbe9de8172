"""The walk along gridline pointers: numbers of a drawn lattice, whatever false pointers do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.tracking.detector import STEPS, CornerGraph
from cmp_tactile_processing.tracking.numbering.components import GridlinePointers, traverse

SIDE = 16.0


def lattice(rows, cols):
    """A perfect lattice with corner (i, j) at x = j sides, y = i sides; node i * cols + j."""
    i, j = np.indices((rows, cols)).reshape(2, -1)
    neighbour = np.full((rows * cols, 4), -1)
    for towards, (di, dj) in enumerate(STEPS):
        a, b = i + di, j + dj
        inside = (a >= 0) & (a < rows) & (b >= 0) & (b < cols)
        neighbour[inside, towards] = (a * cols + b)[inside]
    position = np.stack([j, i], axis=1) * SIDE
    return CornerGraph(position, np.ones(rows * cols, bool), (i + j) % 2 == 0, neighbour)


def true_number(position):
    return np.rint(position[:, ::-1] / SIDE).astype(int)


def steps(count):
    return np.tile([0.0, SIDE], (count, 1)), np.tile([SIDE, 0.0], (count, 1))


def offsets(component):
    return np.unique(component.number - true_number(component.position), axis=0)


def without(graph, nodes):
    merged = graph.merged.copy()
    merged[nodes] = False
    return replace(graph, merged=merged)


@pytest.mark.parametrize("flaw", ["even", "merged"])
def test_a_corner_of_the_wrong_colours_or_of_one_checker_alone_is_left_out(flaw):
    graph = lattice(6, 6)
    values = getattr(graph, flaw).copy()
    values[14] = ~values[14]
    (component,) = traverse(replace(graph, **{flaw: values}))
    assert len(component.position) == 35
    assert not (true_number(component.position) == divmod(14, 6)).all(axis=1).any()
    assert len(offsets(component)) == 1


def test_two_corners_with_one_number_are_both_left_out():
    """A ring of ten corners that closes nowhere comes back to the number of its first."""
    # Right three, down two, left three, up two: the last lies on the first.
    way = [1, 1, 1, 2, 2, 3, 3, 3, 0, 0]
    neighbour = np.full((11, 4), -1)
    place = [np.zeros(2, int)]
    for node, towards in enumerate(way):
        neighbour[node, towards], neighbour[node + 1, (towards + 2) % 4] = node + 1, node
        place.append(place[-1] + STEPS[towards])
    number = np.array(place)
    position = number[:, ::-1] * SIDE
    graph = CornerGraph(position, np.ones(11, bool), number.sum(axis=1) % 2 == 0, neighbour)
    (component,) = traverse(graph)
    assert len(component.position) == 9
    assert not (component.position == 0).all(axis=1).any()


@pytest.mark.parametrize("seed", range(5))
def test_clutter_changes_no_number(seed):
    """200 stray corners, half of them tied to the lattice at random: every number is right."""
    rng = np.random.default_rng(seed)
    graph = lattice(20, 20)
    position = np.concatenate([graph.position, rng.uniform(-60, 380, (200, 2))])
    neighbour = np.concatenate([graph.neighbour, np.full((200, 4), -1)])
    lost = rng.choice(400, 20, replace=False)
    neighbour[lost] = -1
    neighbour[np.isin(neighbour, lost)] = -1
    for node in range(400, 600, 2):
        other, towards = int(rng.integers(400)), int(rng.integers(4))
        if neighbour[other, towards] < 0:
            neighbour[other, towards], neighbour[node, (towards + 2) % 4] = node, other
    even = np.concatenate([graph.even, rng.random(200) < 0.5])
    cluttered = CornerGraph(position, np.ones(600, bool), even, neighbour)
    component = GridlinePointers().components(cluttered, *steps(600), fewest=10)[0]
    ours = np.isin(component.position, graph.position).all(axis=1)
    assert ours.sum() >= 380
    true = replace(component, position=component.position[ours], number=component.number[ours])
    assert len(offsets(true)) == 1


def test_components_come_largest_first_and_small_ones_on_demand():
    graph = without(lattice(6, 12), [12 * i + j for i in range(6) for j in (4, 10)])
    sizes = [len(component.position) for component in traverse(graph)]
    assert sizes == [30, 24, 6]
    assert len(GridlinePointers().components(graph, *steps(72), fewest=7)) == 2
