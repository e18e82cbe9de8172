"""Signed distance, normals and limits of the simple shapes."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.errors import InputError
from cmp_tactile_simulation.indenter_shapes import (
    Cuboid,
    Cylinder,
    FlatProbe,
    HexagonalBar,
    Ring,
    Sphere,
    SphereGroup,
)

SHAPES = [
    Sphere(4e-3),
    Cylinder(3e-3, 8e-3, 3e-4),
    FlatProbe(6e-4, 5e-3, 1e-4),
    Cuboid((4e-3, 6e-3, 5e-3), 4e-4),
    Ring(4e-3, 1e-3),
    HexagonalBar(5e-3, 9e-3, 3e-4),
    SphereGroup([[0, 0, 0], [2e-3, 1e-3, 0.5e-3], [-3e-3, 0, 0]], 1e-3),
]
# Rounding of numbers of some millimetres.
EXACT = 1e-15
# Error of a central difference over 1e-8 m.
GRADIENT_TOLERANCE = 1e-6
ROOT = np.sqrt(0.5)


@pytest.fixture(params=SHAPES, ids=lambda shape: shape.name)
def shape(request):
    return request.param


@pytest.fixture
def points(shape):
    """Around and inside the shape."""
    return np.random.default_rng(5).uniform(-1.2, 1.2, (3000, 3)) * shape.reach


def test_normal_is_the_gradient_of_the_distance(shape, points):
    step = 1e-8
    gap, normal = shape.distance(points)
    offsets = step * np.eye(3)
    slope = [
        (shape.distance(points + offset)[0] - shape.distance(points - offset)[0]) / (2 * step)
        for offset in offsets
    ]
    error = np.linalg.norm(np.stack(slope, axis=1) - normal, axis=1)
    # Inside, the nearest point jumps where two faces are equally near; a few points fall there.
    assert np.mean(error > GRADIENT_TOLERANCE) < 0.002
    assert error[gap > 0].max() < GRADIENT_TOLERANCE or shape.name == "sphere_group"
    assert np.abs(np.linalg.norm(normal, axis=1) - 1).max() < 1e-12


def test_walking_the_distance_along_the_normal_leads_to_the_surface(shape, points):
    """Fails for a distance that is a bound and not exact."""
    gap, normal = shape.distance(points)
    outside = gap > 0
    foot = (points - gap[:, None] * normal)[outside]
    there, foot_normal = shape.distance(foot)
    assert np.abs(there).max() < 10 * EXACT
    assert np.abs(foot_normal - normal[outside]).max() < 1e-6


def test_reach_holds_the_whole_shape(shape):
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    assert (shape.distance(1.0001 * shape.reach * directions)[0] > 0).all()


@pytest.mark.parametrize(
    ("shape", "point", "gap", "normal"),
    [
        (Sphere(4e-3), (0, 0, -5e-3), 1e-3, (0, 0, -1)),
        (Sphere(4e-3), (0, 3e-3, 0), -1e-3, (0, 1, 0)),
        (Cylinder(3e-3, 8e-3), (1e-3, 0, -4e-3), 1e-3, (0, 0, -1)),
        (Cylinder(3e-3, 8e-3), (5e-3, 0, 1e-3), 1e-3, (1, 0, 0)),
        (FlatProbe(6e-4, 5e-3), (1e-4, 0, -2e-4), 2e-4, (0, 0, -1)),
        (FlatProbe(6e-4, 5e-3), (0, 4e-4, 2e-3), 1e-4, (0, 1, 0)),
        (Cuboid((4e-3, 6e-3, 5e-3)), (1e-3, 1e-3, -3.5e-3), 1e-3, (0, 0, -1)),
        (Cuboid((4e-3, 6e-3, 5e-3)), (1.9e-3, 0, 0), -1e-4, (1, 0, 0)),
        # The middle of a rounded edge lies (1 - sqrt(1/2)) radii inside the sharp one.
        (Cuboid((4e-3, 4e-3, 4e-3), 1e-3), (2e-3, 2e-3, 0), 1e-3 / ROOT - 1e-3, (ROOT, ROOT, 0)),
        (Ring(4e-3, 1e-3), (0, 4e-3, -1.5e-3), 5e-4, (0, 0, -1)),
        (Ring(4e-3, 1e-3), (0, 0, 0), 3e-3, None),
        (Ring(4e-3, 1e-3), (0, 0, 3e-3), 4e-3, None),
        (HexagonalBar(5e-3, 9e-3), (0, 0, -3e-3), 5e-4, (0, 0, -1)),
        (HexagonalBar(5e-3, 9e-3, 1e-6), (0, 5e-3 / np.sqrt(3) + 1e-3, 0), 1e-3, (0, 1, 0)),
        (SphereGroup([[0, 0, 0], [3e-3, 0, 0]], 1e-3), (3e-3, 0, -2e-3), 1e-3, (0, 0, -1)),
    ],
)
def test_known_distances(shape, point, gap, normal):
    found, direction = shape.distance(np.array([point], dtype=float))
    # The bar's corner is rounded by 1 um, which takes off 0.15 um.
    assert found[0] == pytest.approx(gap, abs=2e-7 if shape.name == "hexagonal_bar" else 1e-12)
    assert np.linalg.norm(direction[0]) == pytest.approx(1)
    if normal is not None:
        assert direction[0] == pytest.approx(normal, abs=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Cylinder(1e-3, 1e-2, 2e-3), "cylinder.edge_radius: found 0.002 m"),
        (lambda: Ring(1e-3, 2e-3), "ring.tube_radius: found 0.002 m, expected 1e-06 to 0.001 m"),
        (lambda: SphereGroup([[0, 0]], 1e-3), "sphere_group.centres: found an array of shape"),
    ],
)
def test_impossible_sizes_are_named(make, message):
    with pytest.raises(InputError, match=message):
        make()
