"""The whole graph: a bag through the container, in a process of its own, over real DDS topics."""

import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from waiting import wait_until

from cmp_tactile_bringup.command import main
from cmp_tactile_bringup.demo import (
    RESULTS,
    Collector,
    PlayOptions,
    PlayProgress,
    gather,
    run_replay,
)
from cmp_tactile_bringup.report.results import DemoResults, find_recording
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.ros.messages.reading import stamp_ns
from cmp_tactile_processing.sensor.description import load_sensor

# With other tests beside it, frames are sent later, and none is lost.
pytestmark = pytest.mark.ros

RATE_HZ = 20.0
# Messages carry float32: half a unit in the last place of 512 px, 0.02 m and 0.5 N.
ATOL_PX, ATOL_M, ATOL_N = 3.1e-5, 1e-9, 3e-8
PICTURES = ("overview", "wrench", "contacts")
FRAMES = 20


@dataclass(frozen=True)
class Played:
    """What came on each topic, in the order in which it came, and the results made of it."""

    messages: dict[str, list]
    results: DemoResults
    log: str


def play_once(recording, log):
    sensor = load_sensor(recording.sensor)
    with Collector(f"/{sensor.ros_name}") as collector:
        facts = run_replay(collector, recording, PlayOptions(RATE_HZ, log), PlayProgress())
        messages = {
            topic: [item.message for item in collector.arrivals(topic)] for topic in RESULTS
        }
        results = gather(collector, recording, sensor, facts)
    return Played(messages, results, log.read_text())


@pytest.fixture(scope="module")
def recording(grasp_bag):
    return find_recording(str(grasp_bag))


@pytest.fixture(scope="module")
def frames(recording):
    return [frame.image for frame in BagReader(recording.bag).frames()]


@pytest.fixture(scope="module")
def played(recording, tmp_path_factory):
    return play_once(recording, tmp_path_factory.mktemp("played") / "container.log")


def test_each_frame_comes_once_in_order_with_its_stamp_and_frame_id(played, recording):
    for topic in RESULTS:
        headers = [message.header for message in played.messages[topic]]
        assert [stamp_ns(header.stamp) for header in headers] == recording.truth.stamp_ns.tolist()
        view, _, kind = topic.partition("/")
        frame = f"{view}_optical" if kind == "grid" else "gel"
        assert {header.frame_id for header in headers} == {f"sample_rig_{frame}_frame"}
    assert "Traceback" not in played.log
    assert "ERROR" not in played.log


def test_topics_carry_what_the_pipeline_computes(played, frames):
    """Wrong units, order, view or frame in a message or converter would show here."""
    pipeline = Pipeline(played.results.sensor)
    for index in range(11):
        # Every frame is followed from the one before, as the nodes do.
        expected, found = pipeline.process(frames[index]), played.results.frames[index]
        if index not in {0, 9, 10}:
            continue
        for view in ("left", "right"):
            wanted, grid = getattr(expected, view), getattr(found, view)
            np.testing.assert_allclose(grid.corners_frame, wanted.corners_frame, atol=ATOL_PX)
            np.testing.assert_allclose(grid.col_lines, wanted.col_lines, atol=ATOL_PX)
            np.testing.assert_array_equal(grid.row_line_status, wanted.row_line_status)
        # The nodes triangulate from float32 pixels: 3e-5 px are 6 nm in depth.
        np.testing.assert_allclose(found.surface.position, expected.surface.position, atol=2e-8)
        np.testing.assert_allclose(found.force.position, expected.force.position, atol=ATOL_M)
        # Force follows displacement linearly: 2e-8 m of 1e-3 m; at rest, of 1e-6 m of noise, which
        # are some 1e-4 N at a node.
        atol = 1e-3 * np.abs(expected.force.force).max() + 2e-6
        np.testing.assert_allclose(found.force.force, expected.force.force, atol=atol)


@pytest.mark.usefixtures("short_scenes", "grasp_bag")
def test_a_stopped_demo_takes_its_container_with_it(tmp_path):
    command = [sys.executable, "-m", "cmp_tactile_bringup.command", "demo", "--output", tmp_path]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    log = tmp_path / "container.log"
    wait_until(
        lambda: (
            process.poll() is not None
            or (log.exists() and "components are running" in log.read_text())
        ),
        "the start of the nodes",
        timeout_s=400,
    )
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    assert children
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert b"Traceback" not in output
    assert not [child for child in children if Path(f"/proc/{child}").exists()]


def test_the_demo_keeps_its_limits(grasp_bag, tmp_path, capsys):
    """From the command to the page; test_demo has one that misses a limit."""
    output = tmp_path / "output"
    assert main(["demo", "--recording", str(grasp_bag), "--output", str(output)]) == 0
    printed = capsys.readouterr().out
    assert "Limits missed" not in printed
    corners = FRAMES * 2 * 20 * 20
    assert f"{corners} of {corners}" in printed
    assert {path.name for path in output.iterdir()} == {
        "index.html",
        "container.log",
        *(f"{name}.png" for name in PICTURES),
    }
