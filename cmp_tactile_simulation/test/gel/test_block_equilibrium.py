"""Newton's method against a state that is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.elastic.elastomer_mesh import BlockGeometry, BlockMesh
from cmp_tactile_processing.elastic.neo_hookean import NeoHookeanElements
from cmp_tactile_processing.sensor.parts import PatternSurface
from cmp_tactile_simulation.gel.block_equilibrium import BlockEquilibrium
from cmp_tactile_simulation.gel.sparse_cholesky import BlockDissection

POISSON, YOUNG, GAMMA = 0.48, 2.0, 0.6


def test_newton_finds_a_homogeneous_state():
    """Sheared by 0.6 off a bonded base, from rest, by loads that are known in closed form.

    Newton's tolerance is 1e-7 of the load.
    """
    geometry = BlockGeometry((2.0, 1.5, 1.0), PatternSurface(), 0.0)
    x, y = np.array([-1.0, -0.3, 0.2, 0.5, 1.0]), np.array([-0.75, 0.1, 0.75])
    brick = BlockMesh(geometry, x, y, np.array([0.0, 0.6, 1.0]), np.zeros(1))
    elements = NeoHookeanElements.from_mesh(brick, POISSON, YOUNG)
    points = brick.nodes().reshape(-1, 3)
    displacement = np.zeros_like(points)
    displacement[:, 0] = GAMMA * (points[:, 2] - geometry.base)
    load = elements.equilibrium(displacement).force.reshape(*brick.lattice, 3)
    shear = YOUNG / (2 * (1 + POISSON))
    assert load[:, :, -1].sum(axis=(0, 1)) == pytest.approx([GAMMA * shear * 3, 0, 0], abs=1e-10)
    load[:, :, 0] = 0
    block = BlockEquilibrium(elements, BlockDissection(brick.lattice, elements.nodes))
    assert abs(block.move_to(load.reshape(-1, 3)) - displacement).max() < 1e-6
