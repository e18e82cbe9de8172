"""The live sensor: frames of what is asked for, truth beside them, wrong commands named."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.frame_source import SourceOptions
from cmp_tactile_driver.source_registry import find_source
from cmp_tactile_processing.grid import Status
from cmp_tactile_processing.optics import build_views
from cmp_tactile_processing.sensor_library import load_sensor
from cmp_tactile_processing.split import split_frame
from cmp_tactile_processing.tracker import GridTracker
from cmp_tactile_simulation.contact_state import Load
from cmp_tactile_simulation.errors import CommandError, SceneError
from cmp_tactile_simulation.live_contact import LiveMode
from cmp_tactile_simulation.live_motion import LiveSettings
from cmp_tactile_simulation.live_sensor import LiveSensor, live_scene
from cmp_tactile_simulation.pose import Pose
from cmp_tactile_simulation.scene import Start
from cmp_tactile_simulation.scene_library import load_scene

SCENE = Path(__file__).parent / "data" / "live_press.yaml"
RADIUS_M = 0.006
TIMEOUT_S = 120.0
# Root mean square over the corners, at 2 x 2 samples a pixel; offline, at 4 x 4, it is 0.015 px.
ATOL_PX = 0.06


@pytest.fixture
def sensor():
    live = LiveSensor(load_scene(str(SCENE)), settings=LiveSettings(autoplay=False, max_speed=0.1))
    yield live
    live.close()


def read_until(sensor, condition):
    """The first frame that meets the condition."""
    deadline = time.monotonic() + TIMEOUT_S
    while not condition(frame := sensor.read()):
        assert time.monotonic() < deadline, f"waited {TIMEOUT_S:g} s in vain"
        time.sleep(0.005)
    return frame


def assert_shows(sensor, frame, state):
    """The corners in the frame are where they truly are."""
    grids, _ = sensor.truth(state)
    for name, view in build_views(sensor.scene.sensor).items():
        tracker = GridTracker(sensor.scene.sensor, view=name)
        found = tracker.track(split_frame(frame.image, view.placement))
        assert (found.corner_status == Status.MEASURED).all()
        error = np.linalg.norm(found.corners - grids[name].corners, axis=-1)
        assert np.sqrt((error**2).mean()) < ATOL_PX


def at_depth(depth_m):
    return Pose(np.array([0.0, 0.0, RADIUS_M - depth_m]))


def normal_force(frame):
    return 0.0 if frame.state is None else -frame.state.contact.resultant[2]


def test_frames_show_the_gel_at_rest_before_the_first_state(sensor):
    frame = sensor.read()
    assert frame.image.shape == (768, 1024)
    _, surface = sensor.truth(None)
    assert np.nanmax(np.abs(surface.displacement)) == 0
    assert_shows(sensor, frame, None)


def test_a_target_is_reached_and_felt_and_seen(sensor):
    sensor.move_to(at_depth(0.4e-3))
    frame = read_until(sensor, lambda f: sensor.mode is LiveMode.HOLDING and normal_force(f) > 0)
    np.testing.assert_allclose(frame.state.contact.pose.position, [0, 0, RADIUS_M - 0.4e-3])
    _, surface = sensor.truth(frame.state)
    assert np.nanmin(surface.displacement[..., 2]) < -0.1e-3
    field = sensor.force_field(frame.state)
    np.testing.assert_allclose(field.wrench[:3], frame.state.contact.resultant)
    assert_shows(sensor, frame, frame.state)
    assert sensor.health.problem == ""


def test_a_load_is_reached(sensor):
    sensor.settings = replace(sensor.settings, max_load_rate=100.0)
    sensor.press(Load(normal=1.5))
    frame = read_until(sensor, lambda f: sensor.mode is LiveMode.HOLDING and normal_force(f) > 0)
    assert normal_force(frame) == pytest.approx(1.5, rel=0.01)


def test_reset_lifts_the_indenter_and_plays_again_where_it_did_before():
    live = LiveSensor(load_scene(str(SCENE)), settings=LiveSettings(max_speed=0.1))
    try:
        read_until(live, lambda f: normal_force(f) > 0)
        assert live.mode is LiveMode.PLAYING
        live.move_to(at_depth(0.1e-3))
        read_until(live, lambda _: live.mode is LiveMode.HOLDING)
        live.reset()
        read_until(live, lambda f: normal_force(f) == 0)
        assert live.mode is LiveMode.PLAYING
        read_until(live, lambda f: normal_force(f) > 0)
    finally:
        live.close()


def test_what_cannot_be_solved_leaves_the_last_state_and_says_so(sensor):
    """At the rim of the block the contact would go on outside the contact patch."""
    sensor.move_to(at_depth(0.3e-3))
    read_until(sensor, lambda f: sensor.mode is LiveMode.HOLDING and normal_force(f) > 0)
    limit = sensor.scene.sensor.elastomer.size[0] / 2
    sensor.move_to(Pose(np.array([limit, 0.0, RADIUS_M - 3e-3])))
    frame = read_until(sensor, lambda _: sensor.health.problem != "")
    assert frame.state is not None
    assert sensor.mode is LiveMode.HOLDING
    read_until(sensor, lambda f: f.state is not None)
    sensor.move_to(at_depth(0.2e-3))
    read_until(sensor, lambda _: sensor.health.problem == "")


@pytest.mark.parametrize(
    ("position", "message"),
    [
        ([0.02, 0, 0], r"position.x: found 0.02 m, expected -0.011 to 0.011 m"),
        ([0, 0, -0.05], r"position.z: found -0.05 m, expected -0.00"),
        ([0, np.nan, 0], "not finite"),
    ],
)
def test_a_target_out_of_reach_is_refused(sensor, position, message):
    with pytest.raises(CommandError, match=message):
        sensor.move_to(Pose(np.array(position)))


@pytest.mark.parametrize(
    ("load", "message"),
    [
        (Load(0.0), r"force.z: found -?0 N, expected less than 0"),
        (Load(-1.0), "force.z: found 1 N"),
        (Load(1.0, (np.inf, 0.0)), "expected finite numbers"),
        (Load(1.0, torque=np.nan), "expected finite numbers"),
    ],
)
def test_a_load_that_is_none_is_refused(sensor, load, message):
    with pytest.raises(CommandError, match=message):
        sensor.press(load)


def test_a_matrix_that_is_no_rotation_is_refused(sensor):
    with pytest.raises(CommandError, match="no rotation"):
        sensor.move_to(Pose(np.zeros(3), np.diag([1.0, 1.0, -1.0])))


def test_a_scene_that_starts_in_the_gel_fails_with_its_reason():
    scene = replace(load_scene(str(SCENE)), start=Start((0.0, 0.0, 0.005)))
    live = LiveSensor(scene)
    try:
        with pytest.raises(FrameSourceError, match=r"scene live_press: .*inside the gel"):
            read_until(live, lambda _: False)
    finally:
        live.close()


def test_the_driver_finds_the_source_and_its_scene():
    description = load_sensor("prototype")
    live = find_source("simulated")(SourceOptions(str(SCENE), description, frame_rate=12.0))
    assert (live.name, live.frame_rate) == ("scene live_press", 12.0)
    assert live.scene.sensor is description
    assert find_source("simulated")(SourceOptions(str(SCENE), description)).frame_rate == 20.0
    with pytest.raises(SceneError, match="nosuch"):
        find_source("simulated")(SourceOptions("nosuch", description))


def test_what_takes_too_long_is_left_out_live():
    scene = load_scene("grasp")
    live = live_scene(
        replace(scene, camera=replace(scene.camera, motion_samples=8)), LiveSettings()
    )
    assert (live.contact_nodes, live.samples, live.camera.motion_samples) == (24, 2, 1)
    coarse = load_scene(str(SCENE))
    assert live_scene(coarse, LiveSettings(samples=4)).contact_nodes == 12
    assert live_scene(coarse, LiveSettings(samples=4)).samples == 2
