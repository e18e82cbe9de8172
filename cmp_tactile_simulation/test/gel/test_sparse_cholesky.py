"""The sparse factor against scipy's, on a block that is not square."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import splu

from cmp_tactile_processing.elastic.elastomer_mesh import BlockGeometry, BlockMesh, MeshDensity
from cmp_tactile_processing.elastic.neo_hookean import NeoHookeanElements
from cmp_tactile_processing.elastic.stiffness import stiffness
from cmp_tactile_processing.sensor.parts import PatternSurface
from cmp_tactile_simulation.gel.sparse_cholesky import BlockDissection, NotPositiveDefiniteError

# Two ways of solving the same equations differ by what the condition of the matrix, some 1e5,
# makes of rounding.
SAME = 1e-10


@pytest.fixture(scope="module", params=[(1, 1), (5, 3), (2, 7)])
def problem(request):
    """Dissection, element matrices, the whole matrix and which unknowns are free."""
    across, along = request.param
    geometry = BlockGeometry((5.0, 4.0, 2.0), PatternSurface("sphere_cap", 9.0), 0.1)
    lines = np.linspace(-2.5, 2.5, across + 1), np.linspace(-2, 2, along + 1)
    mesh = BlockMesh(geometry, *lines, np.array([0, 0.5, 1]), np.array([0.0, 1.0]))
    elements = NeoHookeanElements.from_mesh(mesh, 0.48, 1.0, 2.0)
    local = elements.tangent(np.zeros((elements.node_count, 3)))
    dissection = BlockDissection(mesh.lattice, elements.nodes)
    free = np.arange(dissection.unknowns) // 3 % mesh.lattice[2] != 0
    return dissection, local, stiffness(mesh, 0.48, 1.0, 2.0), free


def test_solve(problem):
    dissection, local, matrix, free = problem
    load = np.random.default_rng(5).normal(size=dissection.unknowns)
    found = dissection.factor(local).solve(load)
    expected = splu(matrix[free][:, free].tocsc()).solve(load[free])
    assert abs(found[free] - expected).max() < SAME * abs(expected).max()
    assert (found[~free] == 0).all()


def test_compliance(problem):
    """Loads on few unknowns, two of them on the same one, one on a held one alone."""
    dissection, local, matrix, free = problem
    rng = np.random.default_rng(6)
    at = rng.choice(np.flatnonzero(free), 12, replace=False)
    rows = np.concatenate([at, at[:1], np.flatnonzero(~free)[:1]])
    cols = np.concatenate([np.arange(12) % 5, [3], [5]])
    entries = rng.normal(size=len(rows)), (rows, cols)
    loads = sparse.coo_array(entries, shape=(dissection.unknowns, 6)).tocsr()
    dense = loads.toarray()[free]
    expected = dense.T @ splu(matrix[free][:, free].tocsc()).solve(dense)
    found = dissection.factor(local).compliance(loads)
    assert abs(found - expected).max() < SAME * abs(expected).max()


def test_every_free_unknown_is_eliminated_once(problem):
    dissection, _, _, free = problem
    own = np.concatenate([front.unknowns[: front.own] for front in dissection.fronts])
    assert (np.sort(own) == np.flatnonzero(free)).all()


def test_an_unstable_block_has_no_factor(problem):
    dissection, local, _, _ = problem
    softened = local - 1.01 * np.eye(81) * np.linalg.eigvalsh(local[0])[-1]
    with pytest.raises(NotPositiveDefiniteError):
        dissection.factor(softened)


def test_the_order_suits_the_mesh():
    """No front of a long block grows with its length: a seam runs across, not along it."""
    geometry = BlockGeometry((40.0, 4.0, 2.0), PatternSurface(), 0.0)
    mesh = BlockMesh.quarter(geometry, (20.0, 2.0), MeshDensity(40, 0, 1))
    elements = NeoHookeanElements.from_mesh(mesh, 0.4)
    sizes = [len(front.unknowns) for front in BlockDissection(mesh.lattice, elements.nodes).fronts]
    rows = mesh.lattice[1]
    assert max(sizes) <= 3 * 2 * rows * 5
