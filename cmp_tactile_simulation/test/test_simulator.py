"""The simulator from Python: presses by depth, pose and load, with their history and limits."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from cmp_tactile_processing.errors import ContactError, InputError
from cmp_tactile_simulation import Load, Look, Simulator, Sphere
from cmp_tactile_simulation.scenes.simulation import Simulation

# solver.LOAD_TOLERANCE times the normal force.
ATOL_LOAD_N = 1e-6
DEPTH_M = 4e-4


@pytest.fixture(scope="module")
def sensor(small_scene):
    return small_scene().sensor


@pytest.fixture
def simulator(sensor):
    return Simulator(sensor, Sphere(8e-3), friction=0.5, seed=3, contact_nodes=14)


def test_a_scene_and_the_simulator_make_the_same_frame(small_scene, sensor):
    motion = [
        {"name": "press", "frames": 1, "touch": {"at": [0.0005, 0]}},
        {"name": "down", "frames": 1, "by": {"position": [0, 0, -DEPTH_M]}},
    ]
    scene = small_scene(motion=motion, seed=3, samples=1)
    *_, expected = Simulation(scene).frames()
    look = Look(samples=1, seed=3)
    simulator = Simulator(sensor, Sphere(8e-3), friction=0.5, look=look, contact_nodes=14)
    simulator.press(depth=0.0, at=(0.0005, 0.0))
    frame = simulator.press(depth=DEPTH_M, at=(0.0005, 0.0))
    np.testing.assert_array_equal(frame.image, expected.image)
    np.testing.assert_allclose(frame.truth.wrench, expected.force.wrench, atol=1e-9)
    np.testing.assert_allclose(frame.truth.pose.position, expected.pose.position, atol=1e-12)


def test_truth_is_one_state_of_the_gel(simulator):
    frame = simulator.press(depth=DEPTH_M, shear=(1e-4, 0.0))
    truth = frame.truth
    force = truth.traction * frame.node_area[:, None]
    np.testing.assert_allclose(force.sum(axis=0), truth.wrench[:3], atol=1e-12)
    assert truth.displacement.shape == (5, 6, 3)
    assert truth.contact.any()
    assert not truth.traction[~truth.contact].any()
    # Friction pulls the gel along with the ball.
    assert truth.wrench[0] > 0


def test_a_pose_may_be_a_matrix_and_gives_what_the_depth_does(simulator):
    by_depth = simulator.press(depth=DEPTH_M)
    matrix = np.eye(4)
    matrix[:3, 3] = by_depth.truth.pose.position
    simulator.reset()
    by_pose = simulator.press(matrix)
    np.testing.assert_allclose(by_pose.truth.wrench, by_depth.truth.wrench, atol=1e-9)
    assert by_pose.index == 0


def test_history_counts_until_a_reset(simulator):
    straight = simulator.press(depth=DEPTH_M).truth.wrench
    simulator.press(depth=DEPTH_M, shear=(3e-4, 0.0))
    back = simulator.press(depth=DEPTH_M).truth.wrench
    # Nodes that slid on the way are dragged the other way now.
    assert back[0] < -1e-3
    simulator.reset()
    np.testing.assert_allclose(simulator.press(depth=DEPTH_M).truth.wrench, straight, atol=1e-9)


def test_a_load_is_reached_and_given_up(simulator):
    load = Load(0.6, (0.1, 0.0))
    truth = simulator.press(load=load, at=(0.0005, 0.0)).truth
    np.testing.assert_allclose(truth.wrench[:3], [0.1, 0.0, -0.6], atol=ATOL_LOAD_N)
    free = simulator.release(1e-3)
    assert not free.truth.wrench.any()
    assert free.truth.pose.position[2] > truth.pose.position[2] + 1e-3


def test_what_cannot_be_pressed_raises_with_the_limit(simulator):
    before = simulator.press(depth=DEPTH_M).truth.wrench
    with pytest.raises(ContactError, match=r"friction coefficient of 0\.5"):
        simulator.press(load=Load(0.5, (0.4, 0.0)))
    with pytest.raises(ContactError, match="contact patch"):
        simulator.press(depth=DEPTH_M, at=(0.0105, 0.0))
    # The contact is as it was.
    np.testing.assert_allclose(simulator.press(depth=DEPTH_M).truth.wrench, before, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        ({}, "none or several"),
        ({"depth": 1e-4, "load": Load(1.0)}, "none or several"),
        ({"pose": np.eye(3)}, r"shape \(3, 3\)"),
        ({"pose": np.diag([1.0, 1.0, -1.0, 1.0])}, "no rigid motion"),
    ],
)
def test_wrong_arguments_are_named(simulator, arguments, found):
    with pytest.raises(InputError, match=found):
        simulator.press(**arguments)


def test_the_indenter_may_be_a_mesh_file_and_be_changed(simulator, tmp_path):
    file = tmp_path / "ball.stl"
    trimesh.creation.icosphere(subdivisions=6, radius=8.0).export(file)
    ball = simulator.press(depth=DEPTH_M).truth.wrench
    simulator.use(file, friction=0.5, scale=1e-3)
    meshed = simulator.press(depth=DEPTH_M).truth.wrench
    # Facets lie up to 1 um inside the ball: 1.5 times that share of the depth.
    assert meshed[2] == pytest.approx(ball[2], rel=0.005)
    with pytest.raises(InputError, match="friction"):
        simulator.use(file, friction=-1.0, scale=1e-3)


def test_the_seed_sets_the_noise(sensor):
    def image(seed: int) -> np.ndarray:
        return Simulator(sensor, seed=seed, contact_nodes=14).press(depth=DEPTH_M).image

    np.testing.assert_array_equal(image(1), image(1))
    assert (image(1) != image(2)).any()
