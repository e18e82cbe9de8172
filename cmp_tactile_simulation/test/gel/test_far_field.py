"""A large block far from a point load against the half-space of Boussinesq and of Cerruti."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.elastic.mesh import BlockGeometry, MeshDensity
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.sensor.parts import PatternSurface
from cmp_tactile_simulation.gel import ContactProblem

POISSON = 0.3

# A block of 4000 x 4000 x 2000 distances of the nodes, finest under the loaded one.  That it is
# no half-space is left uncorrected: its base, held at depth H, lowers the normal displacement at
# distance r by some 1.2 r / H, here 0.3 %.
SIZE = (4000.0, 4000.0, 2000.0)
DENSITY = MeshDensity(across=8, rim=7, depth=9, growth=2.5)

# Distances, in those of the nodes, at which the displacement is compared.
NEAREST, FARTHEST = 3.0, 5.0


def half_space(x, y):
    """Surface displacement (..., 3) of a half-space, E = 1, at (x, y) from the load.

    Two of them: unit load along -z (Boussinesq) and along +x (Cerruti); Johnson, Contact
    Mechanics, 3.2 and 3.6, with z out of the body.
    """
    r = np.hypot(x, y)
    factor, lateral = (1 + POISSON) / (2 * np.pi), 1 - 2 * POISSON
    normal = [-lateral * x / r**2, -lateral * y / r**2, -2 * (1 - POISSON) / r]
    tangential = [
        2 * (1 - POISSON) / r + 2 * POISSON * x**2 / r**3,
        2 * POISSON * x * y / r**3,
        -lateral * x / r**2,
    ]
    return factor * np.stack([np.stack(normal, -1), np.stack(tangential, -1)])


def spread(x, y):
    """The same for a load that is spread as a hat over one distance to either side."""
    points, weights = np.polynomial.legendre.leggauss(6)
    points = np.concatenate([points - 1, points + 1]) / 2
    weights = np.tile(weights, 2) / 2 * (1 - np.abs(points))
    hat = [
        (a, b, u * v)
        for a, u in zip(points, weights, strict=True)
        for b, v in zip(points, weights, strict=True)
    ]
    return sum(weight * half_space(x - a, y - b) for a, b, weight in hat)


@pytest.fixture(scope="module")
def far_field():
    """Found and expected displacement (2 loads, points, 3) in the ring between the distances."""
    nodes, observers = SurfaceGrid(7, 7, (6.0, 6.0)), SurfaceGrid(11, 11, (10.0, 10.0))
    block = BlockGeometry(SIZE, PatternSurface(), 0.0)
    problem = ContactProblem(block, POISSON, 1.0, observers, nodes, DENSITY)
    forces = np.zeros((7, 7, 3, 2))
    forces[3, 3, 2, 0] = -1
    forces[3, 3, 0, 1] = 1
    moved = problem.expand(problem.solve(forces.reshape(-1, 2)), of_nodes=False)
    x, y = observers.points.T
    ring = (np.hypot(x, y) >= NEAREST) & (np.hypot(x, y) <= FARTHEST)
    assert ring.sum() > 40
    found = np.moveaxis(moved.reshape(-1, 3, 2), -1, 0)[:, ring]
    return found, spread(x[ring], y[ring])


@pytest.mark.parametrize("load", [pytest.param(0, id="Boussinesq"), pytest.param(1, id="Cerruti")])
def test_far_field_is_that_of_a_half_space(far_field, load, record_property):
    """Within 1 % in all three components; 0.3 % of it is the block's size, see above."""
    found, expected = far_field[0][load], far_field[1][load]
    error = np.linalg.norm(found - expected, axis=1) / np.linalg.norm(expected, axis=1)
    record_property("largest_relative_error", float(error.max()))
    assert error.max() < 0.01
