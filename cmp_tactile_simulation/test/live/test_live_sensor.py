"""The live sensor: pictures of what is asked for, truth beside them, wrong commands named."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from waiting import wait_until

from cmp_tactile_driver.sources.frames import SourceOptions, find_source
from cmp_tactile_processing.errors import FrameSourceError, InputError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import Status
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.surface.stillness import RestParameters
from cmp_tactile_processing.tracking.tracker import GridTracker
from cmp_tactile_simulation.contact.laws import Load, Pose
from cmp_tactile_simulation.live.mechanics import LiveMode, LiveSettings, Reset, check_command
from cmp_tactile_simulation.live.sensor import LiveSensor, TruthWanted
from cmp_tactile_simulation.live.source import LiveProcess, SimulatedSource
from cmp_tactile_simulation.scenes.description import Start
from cmp_tactile_simulation.scenes.file import load_scene

SCENE = Path(__file__).parents[1] / "data" / "live_press.yaml"
QUICK = LiveSettings(max_speed=0.1, max_load_rate=100.0)
RATE_HZ = 50.0
ALL = TruthWanted(force=True, optics=True)
RADIUS_M = 0.006
# Root mean square over the corners; offline it is 0.015 px.
ATOL_PX = 0.03


@pytest.fixture
def start():
    """Starts live sensors of a scene, which are closed after the test."""
    with ExitStack() as stack:

        def started(kind=LiveSensor, autoplay=False, **changes):
            scene = replace(load_scene(str(SCENE)), **changes)
            live = kind(scene, replace(QUICK, autoplay=autoplay), RATE_HZ)
            stack.callback(live.close)
            return live

        yield started


def wait(sensor, condition, wanted=ALL):
    """The first frame that meets the condition."""
    frames = []

    def shown():
        frames[:] = [sensor.picture(wanted)]
        return condition(frames[0])

    wait_until(shown, "the frame")
    return frames[0]


def assert_shows_what_is_true(frame):
    """The corners are found where they truly are."""
    description = load_sensor("sample_rig")
    for name, view in build_views(description).items():
        tracker = GridTracker(description, view=name)
        found = tracker.track(split_frame(frame.image, view.placement))
        assert (found.corner_status == Status.MEASURED).all()
        error = np.linalg.norm(found.corners - frame.grids[name].corners, axis=-1)
        assert np.sqrt((error**2).mean()) < ATOL_PX


def at_height(height_m):
    """The pose of the ball with its lowest point so far above the markers' apex."""
    return Pose(np.array([0.0, 0.0, RADIUS_M + height_m]))


def normal_force(frame):
    return 0.0 if frame.force is None else -frame.force.wrench[2]


def held(frame):
    return frame.status.mode is LiveMode.HOLDING and normal_force(frame) > 0


@pytest.mark.parametrize("kind", [LiveSensor, LiveProcess], ids=["thread", "process"])
def test_a_target_is_reached_and_felt_and_seen(start, kind):
    sensor = start(kind)
    sensor.command(at_height(-0.4e-3))
    frame = wait(sensor, held)
    np.testing.assert_allclose(frame.pose.position, [0, 0, RADIUS_M - 0.4e-3])
    assert np.nanmin(frame.surface.displacement[..., 2]) < -0.4e-3
    assert normal_force(frame) > 0.2
    assert_shows_what_is_true(frame)
    assert frame.status.problem == ""
    assert frame.status.steps > 1


def test_the_gel_is_at_rest_before_the_first_state(start):
    """Its model takes longer than the first pictures."""
    frame = start(contact_nodes=16).picture(ALL)
    assert frame.image.shape == (768, 1024)
    assert np.nanmax(np.abs(frame.surface.displacement)) == 0
    assert_shows_what_is_true(frame)


def test_the_scene_plays_until_a_target_comes_and_again_after_a_reset(start):
    live = start(autoplay=True)
    assert wait(live, lambda f: normal_force(f) > 0).status.mode is LiveMode.PLAYING
    live.command(at_height(0.0))
    wait(live, lambda f: f.status.mode is LiveMode.HOLDING)
    live.command(Reset())
    wait(live, lambda f: f.status.mode is LiveMode.PLAYING and normal_force(f) == 0)
    wait(live, lambda f: normal_force(f) > 0)


def test_the_gel_rests_long_enough_for_a_reference_however_slow_pictures_are(start):
    """The scene begins to press in its first frame, which is due after 20 ms."""
    live = start(autoplay=True)
    at_rest = 0
    while (state := live.picture()).pose is None or state.status.steps == 0:
        at_rest += state.pose is not None
        time.sleep(0.05)
    assert at_rest >= 2 * RestParameters().rest_frames, "counting may begin at any of them"


def test_what_cannot_be_solved_leaves_the_last_state_and_says_so(start):
    """At the rim of the block the contact would go on outside the contact patch."""
    sensor = start()
    sensor.command(at_height(0.0))
    wait(sensor, held)
    limit = load_sensor("sample_rig").elastomer.size[0] / 2
    sensor.command(Pose(np.array([limit, 0.0, RADIUS_M - 3e-3])))
    frame = wait(sensor, lambda f: f.status.problem != "")
    assert frame.status.mode is LiveMode.HOLDING
    assert frame.force is not None
    sensor.command(at_height(0.1e-3))
    frame = wait(sensor, lambda f: f.status.problem == "")
    assert frame.status.steps > 1


def test_a_scene_that_starts_in_the_gel_fails_with_its_reason(start):
    live = start(LiveProcess, start=Start((0.0, 0.0, 0.005)))
    with pytest.raises(FrameSourceError, match=r"scene live_press: .*inside the gel"):
        wait(live, lambda _: False)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (Pose(np.array([0.02, 0, 0])), "position.x: found 0.02 m, expected -0.011 to 0.011 m"),
        (Pose(np.array([0, 0, -0.05])), "position.z: found -0.05 m, expected -0.006 to 0.1 m"),
        (Pose(np.array([0, np.nan, 0])), "not finite"),
        (Load(0.0), r"force.z: found -0 N, expected less than 0"),
        (Load(1.0, (np.inf, 0.0)), "expected finite numbers"),
    ],
)
def test_a_command_that_is_none_is_refused(command, message):
    with pytest.raises(InputError, match=message):
        check_command(command, load_sensor("sample_rig"))


def test_a_process_that_is_killed_is_reported_and_can_be_closed(start):
    live = start(LiveProcess)
    live.picture()
    with pytest.raises(InputError, match=r"position\.x"):
        live.command(Pose(np.array([1.0, 0, 0])))
    os.kill(live._process.pid, signal.SIGKILL)
    live._process.wait()
    live.command(Reset())
    with pytest.raises(FrameSourceError, match="its process ended with code -9"):
        live.picture()


ORPHAN = """
import os, sys
from cmp_tactile_simulation.live.mechanics import LiveSettings
from cmp_tactile_simulation.live.source import LiveProcess
from cmp_tactile_simulation.scenes.file import load_scene
live = LiveProcess(load_scene(sys.argv[1]), LiveSettings(), 20.0)
live.picture()
print(live._process.pid, flush=True)
os._exit(1)
"""


def test_the_process_ends_with_the_one_that_started_it():
    ended = subprocess.run(
        [sys.executable, "-c", ORPHAN, str(SCENE)], capture_output=True, text=True, check=False
    )
    orphan = Path(f"/proc/{int(ended.stdout)}")
    wait_until(
        lambda: not orphan.exists() or "zombie" in (orphan / "status").read_text(), "its end"
    )


def test_an_interrupted_source_gives_no_more_frames_and_leaves_no_process():
    """Also while the first frame, which takes longest, is waited for."""
    source = SimulatedSource(load_scene(str(SCENE)))
    with ThreadPoolExecutor(1) as pool:
        frames = pool.submit(lambda: [source.read() for _ in range(10**6)])
        wait_until(lambda: source._live, "the live sensor")
        live = source._live
        source.interrupt()
        with pytest.raises(FrameSourceError, match="ended"):
            frames.result()
    assert isinstance(live, LiveProcess)
    assert live._process.poll() is not None
    with pytest.raises(FrameSourceError, match="scene live_press: has ended"):
        source.command(Reset())


def test_the_driver_finds_the_source_and_its_scene():
    description = load_sensor("prototype")
    source = find_source("simulated")(SourceOptions(str(SCENE), description, frame_rate=12.0))
    assert (source.name, source.frame_rate) == ("scene live_press", 12.0)
    assert source.scene.sensor is description
    assert find_source("simulated")(SourceOptions(str(SCENE), description)).frame_rate == 20.0
    with pytest.raises(InputError, match="nosuch"):
        find_source("simulated")(SourceOptions("nosuch", description))
