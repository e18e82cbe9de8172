"""Contact on the finite elements of a sensor's gel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.errors import ContactError
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.sensor.parts import PatternSurface
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import Pose
from cmp_tactile_simulation.gel import LinearElastomer
from cmp_tactile_simulation.indenter_shapes import Sphere

YOUNG, POISSON, THICKNESS = 5e5, 0.49, 6e-3
RADIUS = 12e-3


def elastomer(surface, nodes, cache_dir):
    """A gel of 22 x 22 x 6 mm with a contact patch of 5 mm."""
    sensor = load_sensor("prototype")
    return LinearElastomer(
        replace(
            sensor,
            pattern=replace(sensor.pattern, surface=surface, rows=4, cols=4, pitch=6e-4),
            elastomer=replace(sensor.elastomer, young=YOUNG, poisson=POISSON),
        ),
        nodes,
        cache_dir,
    )


@pytest.fixture(scope="module")
def layer(tmp_path_factory):
    return elastomer(PatternSurface(), 18, tmp_path_factory.mktemp("layer"))


@pytest.fixture(scope="module")
def dome(tmp_path_factory):
    return elastomer(PatternSurface("sphere_cap", 0.027), 12, tmp_path_factory.mktemp("dome"))


def at(x, y, z):
    return Pose(np.array([x, y, z]))


def dimitriadis(depth):
    """Force of a sphere on a bonded layer (Dimitriadis et al. 2002, eq. 12 with their fits)."""
    nu = POISSON
    a = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1 - nu)
    b = (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1 - nu)
    c = np.sqrt(RADIUS * depth) / THICKNESS
    series = (
        1
        - 2 * a / np.pi * c
        + 4 * a**2 / np.pi**2 * c**2
        - 8 / np.pi**3 * (a**3 + 4 * np.pi**2 / 15 * b) * c**3
        + 16 * a / np.pi**4 * (a**3 + 3 * np.pi**2 / 5 * b) * c**4
    )
    return 4 / 3 * YOUNG / (1 - nu**2) * np.sqrt(RADIUS) * depth**1.5 * series


@pytest.mark.parametrize("share", [0.2, 0.25, 0.3])
def test_sphere_on_a_bonded_layer_is_dimitriadis(layer, share, record_property):
    """share: sqrt(R d) / h; below, the contact is four nodes wide, above, the series ends."""
    simulation = ContactSimulation(layer, Sphere(RADIUS), 0.0)
    top = layer.node_position[0, 2] + RADIUS
    depth = (share * THICKNESS) ** 2 / RADIUS
    state = simulation.move(simulation.rest(at(0, 0, top)), at(0, 0, top - depth))
    error = -state.resultant[2] / dimitriadis(depth) - 1
    record_property("error", error)
    assert abs(error) < 0.05


def test_indenter_in_the_gel_outside_the_patch_is_refused(dome):
    simulation = ContactSimulation(dome, Sphere(2e-3), 0.5)
    side = dome.beyond[np.linalg.norm(dome.beyond[:, :2] - (6e-3, 0), axis=1).argmin()]
    simulation.rest(at(*(side + (0, 0, 2.1e-3))))
    with pytest.raises(
        ContactError, match=r"outside of the contact patch, at \(.*expected a contact inside"
    ):
        simulation.rest(at(*(side + (0, 0, 1.5e-3))))


def test_touch_lies_on_the_gel_between_its_nodes(dome):
    radius, cap = 2e-3, 0.027
    simulation = ContactSimulation(dome, Sphere(radius), 0.5)
    pose = simulation.touch(at(5e-4, -3e-4, 7.0))
    simulation.rest(pose)
    assert pose.position[:2].tolist() == [5e-4, -3e-4]
    # The cap is a ball of 27 mm with its apex at the height of the contact surface.
    apex = dome.node_position[:, 2].max() + (dome.node_position[:, :2] ** 2).sum(axis=1).min() / (
        2 * cap
    )
    distance = np.linalg.norm(pose.position - (0, 0, apex - cap))
    # It is looked for at points that lie at most 0.07 mm from where the balls touch.
    assert distance == pytest.approx(cap + radius, abs=1.3e-6)
