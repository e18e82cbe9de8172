"""Elimination by nested dissection against scipy's factor, on blocks that are not square."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import splu

from cmp_tactile_processing.elastic.cholesky import Dissection, RestInverse
from cmp_tactile_processing.elastic.mesh import (
    BlockGeometry,
    BlockMesh,
    MeshDensity,
    element_stiffness,
    stiffness,
)
from cmp_tactile_processing.elastic.mirror_symmetry import PARITIES
from cmp_tactile_processing.sensor.parts import PatternSurface

# Two ways of solving the same equations differ by what the condition of the matrix, some 1e5,
# makes of rounding.
SAME = 1e-10
MODULI = 0.48, 1.0, 2.0


@pytest.fixture(
    scope="module", params=[(1, 1, None), (5, 3, None), (2, 7, PARITIES[1]), (13, 9, None)]
)
def problem(request):
    """Dissection, element matrices, the whole matrix and which unknowns are free."""
    across, along, parity = request.param
    geometry = BlockGeometry((5.0, 4.0, 2.0), PatternSurface("sphere_cap", 9.0), 0.1)
    lines = np.linspace(-2.5, 2.5, across + 1), np.linspace(-2, 2, along + 1)
    mesh = BlockMesh(geometry, *lines, np.array([0, 0.5, 1]), np.array([0.0, 1.0]))
    held = None if parity is None else parity.free(mesh.lattice)
    dissection = Dissection(mesh.lattice, mesh.element_nodes(), held)
    free = np.arange(dissection.unknowns) // 3 % mesh.lattice[2] != 0
    free = free if held is None else held.ravel()
    return dissection, element_stiffness(mesh, *MODULI), stiffness(mesh, *MODULI), free


@pytest.fixture(scope="module")
def loads(problem):
    """Loads on few unknowns, two of them on the same one, one on a held one alone."""
    dissection, _, _, free = problem
    rng = np.random.default_rng(6)
    at = rng.choice(np.flatnonzero(free), 12, replace=False)
    rows = np.concatenate([at, at[:1], np.flatnonzero(~free)[:1]])
    cols = np.concatenate([np.arange(12) % 5, [3], [5]])
    entries = rng.normal(size=len(rows)), (rows, cols)
    return sparse.coo_array(entries, shape=(dissection.unknowns, 6)).tocsr()


def solved(problem, loads):
    """Displacement of all unknowns by scipy's factor."""
    _, _, matrix, free = problem
    moved = np.zeros(loads.shape)
    moved[free] = splu(matrix[free][:, free].tocsc()).solve(loads[free])
    return moved


def close(found, expected):
    return abs(found - expected).max() < SAME * abs(expected).max()


def test_solve(problem):
    """A region that touched one on the other side of a seam would give wrong numbers silently."""
    load = np.random.default_rng(5).normal(size=problem[0].unknowns)
    found, expected = problem[0].factor(problem[1]).solve(load), solved(problem, load)
    assert close(found, expected)
    assert (found[~problem[3]] == 0).all()


def test_compliance_and_products_with_the_inverse(problem, loads):
    """Observers that lie all over the block, and loads on few unknowns."""
    rng = np.random.default_rng(8)
    observers = sparse.random_array((loads.shape[0], 7), density=0.2, rng=rng, format="csc")
    moved = solved(problem, loads.toarray())
    seen, work = problem[0].inverse_product(problem[1], observers, loads)
    assert close(seen, observers.T @ moved)
    assert close(work, loads.T @ moved)
    assert close(problem[0].factor(problem[1]).compliance(loads), loads.T @ moved)


def test_the_inverse_at_rest():
    """Against the assembled stiffness; single precision, and a condition of some 1e4."""
    geometry = BlockGeometry((0.022, 0.018, 0.006), PatternSurface("sphere_cap", 0.027), 3e-4)
    quarter = BlockMesh.quarter(geometry, (7e-3, 6e-3), MeshDensity(4, 1, 2, growth=2.0))
    inverse = RestInverse(quarter)
    numbers = inverse.build(0.48, 2.0)
    assert len(numbers) == inverse.size
    inverse.use(numbers)
    whole = quarter.mirrored()
    moved = np.random.default_rng(0).normal(size=(*whole.lattice, 3))
    moved[:, :, 0] = 0
    load = stiffness(whole, 0.48, layer_young=2.0) @ moved.ravel()
    found = inverse.solve(load.reshape(-1, 3)).reshape(moved.shape)
    assert abs(found - moved).max() < 3e-3
    assert (found[:, :, 0] == 0).all()
