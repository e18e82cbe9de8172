"""The neo-Hookean element: derivatives, closed forms, objectivity, limit at small strain."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.elastic.equilibrium import NewtonEquilibrium
from cmp_tactile_processing.elastic.mesh import BlockGeometry, BlockMesh, assembled, stiffness
from cmp_tactile_processing.elastic.neo_hookean import NeoHookeanElements
from cmp_tactile_processing.sensor.parts import PatternSurface

POISSON, YOUNG, LAYER_YOUNG = 0.48, 2.0, 5.0
SHEAR = YOUNG / (2 * (1 + POISSON))
BULK = 2 * SHEAR * POISSON / (1 - 2 * POISSON)

# Central differences of step h err by h^2 of the third derivative and by rounding over h,
# 3e-8 here.
DIFFERENCE_STEP, DIFFERENCE_TOLERANCE = 1e-5, 2e-7
# Sums of some hundred terms in double precision.
ROUNDING = 1e-12


def block_mesh(surface: PatternSurface, layer: float) -> BlockMesh:
    """4 x 2 columns of unequal elements under a block of 2 x 1.5 x 1."""
    geometry = BlockGeometry((2.0, 1.5, 1.0), surface, layer)
    body, skin = np.array([0.0, 0.6, 1.0]), np.array([0.0, 1.0]) if layer else np.zeros(1)
    x, y = np.array([-1.0, -0.3, 0.2, 0.5, 1.0]), np.array([-0.75, 0.1, 0.75])
    return BlockMesh(geometry, x, y, body, skin)


CAP = block_mesh(PatternSurface("sphere_cap", 2.0), 0.15)
BRICK = block_mesh(PatternSurface(), 0.0)


@pytest.fixture(scope="module")
def cap() -> NeoHookeanElements:
    return NeoHookeanElements.from_mesh(CAP, POISSON, YOUNG, LAYER_YOUNG)


@pytest.fixture(scope="module")
def brick() -> NeoHookeanElements:
    return NeoHookeanElements.from_mesh(BRICK, POISSON, YOUNG)


@pytest.fixture(scope="module")
def large(cap):
    """A displacement of large strain, up to a stretch of 1.7, that turns nothing inside out."""
    points, rng = CAP.nodes().reshape(-1, 3), np.random.default_rng(3)
    smooth = np.sin(points @ rng.normal(size=(3, 3))) * 0.2
    displacement = smooth + 0.01 * rng.normal(size=points.shape)
    assert np.isfinite(cap.equilibrium(displacement).energy)
    assert 1.5 < cap.greatest_stretch(displacement) < 2
    return displacement


def difference(function, at, way):
    step = DIFFERENCE_STEP
    return (function(at + step * way) - function(at - step * way)) / (2 * step)


def test_force_is_the_gradient_of_the_energy(cap, large):
    force = cap.equilibrium(large).force
    for seed in range(3):
        way = np.random.default_rng(seed).normal(size=large.shape)
        found = difference(lambda u: cap.equilibrium(u).energy, large, way)
        assert np.vdot(force, way) == pytest.approx(found, rel=DIFFERENCE_TOLERANCE)


def test_tangent_is_the_gradient_of_the_force(cap, large):
    tangent = assembled(cap.tangent(large), cap.nodes)
    way = np.random.default_rng(1).normal(size=large.shape)
    found = difference(lambda u: cap.equilibrium(u).force, large, way)
    predicted = (tangent @ way.ravel()).reshape(-1, 3)
    assert abs(predicted - found).max() < DIFFERENCE_TOLERANCE * abs(found).max()
    assert abs(tangent - tangent.T).max() < ROUNDING * abs(tangent).max()


def test_at_rest_it_is_the_linear_material(cap):
    """Moduli, the skin's own modulus and both integration rules; any other split differs."""
    tangent = assembled(cap.tangent(np.zeros((cap.node_count, 3))), cap.nodes)
    linear = stiffness(CAP, POISSON, YOUNG, LAYER_YOUNG)
    assert abs(tangent - linear).max() < ROUNDING * abs(linear).max()


@pytest.mark.parametrize("strain", [0, 1], ids=["rest", "strained"])
def test_a_rotated_state_has_rotated_forces_and_the_same_energy(cap, large, strain):
    points, state = CAP.nodes().reshape(-1, 3), strain * large
    turn = Rotation.from_rotvec([-0.3, 1.1, 2.0]).as_matrix()
    plain, turned = cap.equilibrium(state), cap.equilibrium((points + state) @ turn.T - points)
    scale = YOUNG * np.prod(CAP.geometry.size) if strain == 0 else 0
    assert turned.energy == pytest.approx(plain.energy, rel=ROUNDING, abs=ROUNDING * scale)
    size = max(scale, abs(plain.force).max())
    assert abs(turned.force - plain.force @ turn.T).max() < ROUNDING * size


def stress_of(gradient: np.ndarray) -> np.ndarray:
    """First Piola-Kirchhoff stress of the energy in the module's docstring, by textbook."""
    volume, inverse = np.linalg.det(gradient), np.linalg.inv(gradient).T
    return SHEAR * (gradient - inverse) + BULK * (volume - 1) * volume * inverse


def force_on_side(force: np.ndarray, axis: int) -> np.ndarray:
    """Sum of the nodal forces on the side of the brick at the upper end of an axis, (3,)."""
    return force.reshape(*BRICK.lattice, 3).take(-1, axis).sum(axis=(0, 1))


AREAS = np.array([1.5 * 1.0, 2.0 * 1.0, 2.0 * 1.5])


@pytest.mark.parametrize("stretch", [0.5, 0.8, 1.3, 2.5])
def test_uniaxial_stretch_of_a_free_brick(brick, stretch):
    """The sides are free and the ends carry the closed form's stress; nothing acts inside."""

    def sideways(side):
        return stress_of(np.diag([stretch, side, side]))[1, 1]

    side = brentq(sideways, 0.2, 3.0, xtol=1e-15)
    points = BRICK.nodes().reshape(-1, 3)
    force = brick.equilibrium(points * [stretch - 1, side - 1, side - 1]).force
    end = stress_of(np.diag([stretch, side, side]))[0, 0] * AREAS[0]
    assert np.sign(end) == np.sign(stretch - 1)
    assert force_on_side(force, 0) == pytest.approx([end, 0, 0], abs=1e-10)
    assert abs(force.reshape(*BRICK.lattice, 3)[1:-1]).max() < 1e-10
    third = 2 * SHEAR * (1 + POISSON)  # Young's modulus bounds the closed form's slope at rest
    assert abs(end) / AREAS[0] < third * max(abs(stretch - 1), abs(1 - stretch**-2))


def test_an_element_turned_inside_out_has_no_finite_energy(brick):
    points = BRICK.nodes().reshape(-1, 3)
    assert brick.equilibrium(-0.999 * points * [0, 0, 1]).energy < np.inf
    assert brick.equilibrium(-1.001 * points * [0, 0, 1]).energy == np.inf


def test_newton_finds_a_homogeneous_state(brick):
    """Sheared by 0.6 off a bonded base, from rest, by loads that are known in closed form.

    Newton's tolerance is 1e-7 of the load.
    """
    gamma, points = 0.6, BRICK.nodes().reshape(-1, 3)
    displacement = np.zeros_like(points)
    displacement[:, 0] = gamma * (points[:, 2] - BRICK.geometry.base)
    load = brick.equilibrium(displacement).force.reshape(*BRICK.lattice, 3)
    load[:, :, 0] = 0
    block = NewtonEquilibrium(BRICK, brick)
    assert abs(block.move_to(load.reshape(-1, 3)) - displacement).max() < 1e-6
