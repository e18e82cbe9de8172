"""The neo-Hookean gel: its limit at small loads, its tangent, its balance, and its end."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.elastic.mesh import MeshDensity
from cmp_tactile_processing.errors import ContactError
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import Pose
from cmp_tactile_simulation.gel import LinearElastomer
from cmp_tactile_simulation.indenter_shapes import Sphere
from cmp_tactile_simulation.neo_hookean_gel import NeoHookeanElastomer

NODES = 11
COARSE = MeshDensity(across=6, rim=1, depth=2, growth=2.0)

# A press under which the gel gives way by a tenth of its thickness, N.
LARGE = 1.2


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def linear(gel, cache):
    return LinearElastomer(gel(), NODES, cache)


@pytest.fixture
def neo(gel, cache):
    """A gel at rest that no other test has loaded."""
    return NeoHookeanElastomer(gel(), NODES, cache, density=COARSE)


def press(elastomer, normal, along_x=0.0):
    """Nodal forces of a smooth bump, radius 2 mm, off the middle."""
    x, y = (elastomer.nodes.points - [2e-4, -3e-4]).T
    bump = np.maximum(0, 1 - (x**2 + y**2) / 2e-3**2)
    return bump[:, None] / bump.sum() * [along_x, 0, -normal]


def test_it_tends_to_the_linear_gel(neo, linear):
    """What large strain adds is of second order in the load: half the load, a quarter of it."""
    loads = LARGE * 2.0 ** -np.arange(4, 8)
    beyond, of_markers = [], []
    for load in loads:
        force = press(neo, load, 0.3 * load)
        beyond.append(np.linalg.norm(neo.displacement(force) - linear.displacement(force)))
        moved = neo.marker_displacement(force) - linear.marker_displacement(force)
        of_markers.append(np.linalg.norm(moved))
    for found in (beyond, of_markers):
        orders = np.diff(np.log(found)) / np.diff(np.log(loads))
        assert orders == pytest.approx(2, abs=0.1)
        assert abs(orders[-1] - 2) < abs(orders[0] - 2)


def test_the_way_to_a_load_does_not_matter(neo, gel, cache):
    """An elastic gel has no memory; Newton's tolerance, 1e-7 of the load, is what is left of it."""
    other = NeoHookeanElastomer(gel(), NODES, cache, density=COARSE)
    goal = press(neo, LARGE, 0.2)
    straight = neo.displacement(goal)
    for force in (press(other, 0.5 * LARGE, -0.3), press(other, 0.9 * LARGE), goal):
        other_way = other.displacement(force)
    assert abs(other_way - straight).max() < 1e-5 * abs(straight).max()


def test_compliance_is_the_tangent(neo, linear):
    """Symmetric, positive, and at a large press a better guess than the linear one by far."""
    force = press(neo, LARGE, 0.3)
    before = neo.displacement(force)
    active = np.flatnonzero(force.any(axis=1))[::2]
    tangent = neo.compliance(active)
    assert abs(tangent - tangent.T).max() < 1e-12 * abs(tangent).max()
    assert np.linalg.eigvalsh(tangent).min() > 0
    change = np.zeros_like(force)
    change[active] = 1e-3 * np.random.default_rng(2).normal(size=(len(active), 3))
    moved = (neo.displacement(force + change) - before)[active].ravel()
    missed = np.linalg.norm(tangent @ change[active].ravel() - moved)
    missed_by_linear = np.linalg.norm(linear.compliance(active) @ change[active].ravel() - moved)
    assert missed < 0.05 * np.linalg.norm(moved)
    assert missed < 0.2 * missed_by_linear


def test_a_large_press_stiffens(neo, linear):
    """The share by which the gel is stiffer than the linear one grows with the depth."""
    ratio = []
    for depth in (3e-4, 9e-4):
        normal = []
        for elastomer in (neo, linear):
            contact = ContactSimulation(elastomer, Sphere(5e-3), 0.5)
            state = contact.rest(contact.touch(Pose(np.array([0, 0, 0.02]))))
            state = contact.move(state, Pose(state.pose.position - [0, 0, depth]))
            normal.append(-state.resultant[2])
        ratio.append(normal[0] / normal[1])
    assert ratio[1] > 1.01
    assert ratio[1] > ratio[0]


def test_the_material_ends_with_a_clear_error(neo):
    """After the error the gel is as good as before."""
    force = press(neo, LARGE)
    before = neo.displacement(force)
    with pytest.raises(ContactError, match=r"load \(0, 0, -500\) N.*greatest stretch"):
        neo.displacement(press(neo, 500.0))
    assert abs(neo.displacement(force) - before).max() < 1e-5 * abs(before).max()
