"""The true force field of a simulated contact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.measured import SlipState
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import Pose
from cmp_tactile_simulation.gel import LinearElastomer
from cmp_tactile_simulation.indenter_shapes import Sphere
from cmp_tactile_simulation.simulator import force_field


@pytest.fixture(scope="module")
def sensor():
    sensor = load_sensor("prototype")
    return replace(sensor, pattern=replace(sensor.pattern, rows=4, cols=4, pitch=6e-4))


@pytest.fixture(scope="module")
def gel(sensor, tmp_path_factory):
    return LinearElastomer(sensor, 9, tmp_path_factory.mktemp("gel"))


@pytest.fixture(scope="module")
def simulation(gel):
    return ContactSimulation(gel, Sphere(6e-3), 0.4)


@pytest.fixture(scope="module")
def pressed(simulation):
    state = simulation.rest(simulation.touch(Pose(np.array([4e-4, -2e-4, 0]))))
    return simulation.move(state, Pose(state.pose.position - (0, 0, 2e-4)))


@pytest.fixture(scope="module")
def dragged(simulation, pressed):
    return simulation.move(pressed, Pose(pressed.pose.position + (4e-5, 0, 0)))


def test_wrench_is_that_of_the_forces_where_they_act_now(gel, sensor, simulation, dragged):
    field = force_field(simulation, dragged, sensor)
    force = np.zeros(3)
    moment = np.zeros(3)
    for rest, moved, part in zip(
        gel.node_position, dragged.displacement, dragged.force, strict=True
    ):
        force += part
        moment += np.cross(rest + moved, part)
    assert field.wrench == pytest.approx(np.concatenate([force, moment]), rel=1e-9, abs=1e-15)
    assert field.wrench[0] > 0 > field.wrench[2]
    assert not field.reference_point.any()


def test_force_at_the_centre_of_pressure_has_the_moment(gel, sensor, simulation, pressed):
    """About x and y, for the force along z."""
    field = force_field(simulation, pressed, sensor)
    place = gel.node_position + pressed.displacement
    along_z = np.cross(place, pressed.force * (0, 0, 1)).sum(axis=0)
    centre = np.cross(field.centre_of_pressure, field.wrench[:3] * (0, 0, 1))
    assert centre[:2] == pytest.approx(along_z[:2], rel=1e-9)


def test_friction_is_reported_of_what_slides(sensor, simulation, pressed, dragged):
    """Where all slides the traction ratio is the friction, less what the ball's curve takes."""
    stuck = replace(pressed, slipping=np.zeros_like(pressed.slipping))
    slip = force_field(simulation, stuck, sensor).slip
    assert slip.state is SlipState.STICK
    assert slip.slip_ratio == 0
    assert slip.traction_ratio < 0.1
    assert np.isnan([slip.friction_coefficient, slip.friction_std]).all()
    part = force_field(simulation, dragged, sensor).slip
    assert 0 < part.slip_ratio < 1
    assert (part.friction_coefficient, part.friction_std) == (0.4, 0.0)
    assert slip.traction_ratio < part.traction_ratio < 0.4
    far = simulation.move(dragged, Pose(dragged.pose.position + (4e-4, 0, 0)))
    full = force_field(simulation, far, sensor).slip
    assert (part.state, full.state) == (SlipState.INCIPIENT, SlipState.FULL)
    assert full.slip_ratio == 1
    # Hertz: a contact of radius a on a ball of radius R turns normals by up to a / R = 0.2.
    assert full.traction_ratio == pytest.approx(0.4, rel=0.02)
