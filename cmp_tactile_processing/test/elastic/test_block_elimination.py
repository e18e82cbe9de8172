"""Elimination by nested dissection against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from cmp_tactile_processing.elastic.block_elimination import Block, inverse_product
from cmp_tactile_processing.elastic.nested_dissection import dissected

ELEMENTS = [(1, 1), (5, 1), (2, 7), (6, 5), (13, 9)]


def neighbours(elements):
    """Whether two lattice columns share an element, (columns, columns) bool."""
    nx, ny = (2 * count + 1 for count in elements)
    coupled = np.zeros((nx * ny, nx * ny), dtype=bool)
    numbers = np.arange(nx * ny).reshape(nx, ny)
    for x in range(elements[0]):
        for y in range(elements[1]):
            columns = numbers[2 * x : 2 * x + 3, 2 * y : 2 * y + 3].ravel()
            coupled[np.ix_(columns, columns)] = True
    return coupled


@pytest.mark.parametrize("elements", ELEMENTS)
def test_halves_are_coupled_through_later_seams_alone(elements):
    """Elimination gives wrong numbers, without a word, where a region touches a sibling."""
    regions, coupled = dissected(elements), neighbours(elements)
    every = np.concatenate([region.columns for region in regions])
    assert sorted(every) == list(range(len(coupled)))
    below: list[set[int]] = []
    for number, region in enumerate(regions):
        assert all(child < number for child in region.children)
        below.append({number}.union(*(below[child] for child in region.children)))
    assert below[-1] == set(range(len(regions)))
    for number, region in enumerate(regions):
        earlier = [other for other in range(number) if other not in below[number]]
        for other in earlier:
            assert not coupled[np.ix_(region.columns, regions[other].columns)].any()


@pytest.mark.parametrize("elements", ELEMENTS)
def test_products_with_the_inverse(elements):
    """Columns that begin in the last region, in the first and in all of them."""
    rng = np.random.default_rng(5)
    regions, coupled = dissected(elements), neighbours(elements)
    order = np.concatenate([region.columns for region in regions])
    stops = np.cumsum([len(region.columns) for region in regions])
    blocks = [
        Block(int(stop) - len(region.columns), int(stop), region.children)
        for stop, region in zip(stops, regions, strict=True)
    ]
    dense = np.where(coupled, rng.normal(size=coupled.shape), 0)
    dense = (dense @ dense.T * coupled)[np.ix_(order, order)]
    dense += np.diag(1 - np.linalg.eigvalsh(dense)[0] + rng.random(len(dense)))
    observers = sparse.random_array((len(dense), 7), density=0.2, rng=rng, format="csc")
    loads = sparse.csc_array(np.eye(len(dense))[:, [0, len(dense) // 2, len(dense) - 1]])
    seen, work = inverse_product(sparse.csr_array(dense), blocks, observers, loads)
    moved = np.linalg.solve(dense, loads.toarray())
    np.testing.assert_allclose(seen, observers.T @ moved, atol=1e-12 * np.abs(moved).max())
    np.testing.assert_allclose(work, loads.T @ moved, atol=1e-12 * np.abs(moved).max())
