"""The whole graph: a bag through the container, in a process of its own, over real DDS topics."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

from cmp_tactile_bringup.demo_collector import RESULTS, Collector
from cmp_tactile_bringup.demo_container import ContainerError, ContainerProcess
from cmp_tactile_bringup.demo_gather import gather
from cmp_tactile_bringup.demo_run import PlayOptions, PlayProgress, run_replay
from cmp_tactile_bringup.recording import Recording, find_recording, write_recording
from cmp_tactile_bringup.report.evaluation import evaluate, table_rows
from cmp_tactile_bringup.report.results import DemoResults
from cmp_tactile_driver.bag_reader import BagReader
from cmp_tactile_processing.nodes.conversions import stamp_ns
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor_library import load_sensor

pytestmark = pytest.mark.ros

RATE_HZ = 20.0
# Messages carry float32: half a unit in the last place of 512 px, 0.02 m and 0.5 N.
ATOL_PX, ATOL_M, ATOL_N = 3.1e-5, 1e-9, 3e-8
PICTURES = ("overview", "frame", "displacement", "knock", "force", "wrench")
NOTES = """\
title: {title}
sensor: sample_rig
phases:
  - {{name: drag, first_frame: 0}}
  - {{name: hold, first_frame: 4}}
"""


@dataclass(frozen=True)
class Played:
    """What came on each topic, in the order in which it came, and the results made of it."""

    messages: dict[str, list]
    results: DemoResults
    log: str


def play_once(recording: Recording, log: Path) -> Played:
    sensor = load_sensor(recording.sensor)
    with Collector(f"/{sensor.ros_name}") as collector:
        facts = run_replay(collector, recording, PlayOptions(RATE_HZ, log), PlayProgress())
        messages = {
            topic: [item.message for item in collector.arrivals(topic)] for topic in RESULTS
        }
        results = gather(collector, recording, sensor, facts)
    return Played(messages, results, log.read_text())


@pytest.fixture(scope="module")
def recording() -> Recording:
    return find_recording("grasp")


@pytest.fixture(scope="module")
def frames(recording) -> list[np.ndarray]:
    return [frame.image for frame in BagReader(recording.bag).frames()]


@pytest.fixture(scope="module")
def played(recording, tmp_path_factory) -> Played:
    return play_once(recording, tmp_path_factory.mktemp("played") / "container.log")


@pytest.mark.parametrize("topic", RESULTS)
def test_each_frame_comes_once_in_order_with_its_stamp(played, recording, topic):
    stamps = [stamp_ns(message.header.stamp) for message in played.messages[topic]]
    assert stamps == recording.truth.stamp_ns.tolist()


def test_frame_ids_are_those_of_the_sensor(played):
    expected = {
        "left/grid": "sample_rig_left_optical_frame",
        "right/grid": "sample_rig_right_optical_frame",
        "surface": "sample_rig_gel_frame",
        "force_field": "sample_rig_gel_frame",
        "wrench": "sample_rig_gel_frame",
    }
    found = {topic: {m.header.frame_id for m in played.messages[topic]} for topic in RESULTS}
    assert found == {topic: {frame_id} for topic, frame_id in expected.items()}


def test_images_on_the_topic_are_those_of_the_bag(recording, frames, tmp_path):
    """Slowly, and best effort: images of 0.8 MB are not for sure to reach another process."""
    wanted = dict(zip(recording.truth.stamp_ns.tolist(), frames, strict=True))
    arguments = {"input": str(recording.bag), "sensor": "sample_rig", "rate": "0.2"}
    images: list[Image] = []
    with Collector("/sample_rig") as collector:
        collector.node.create_subscription(
            Image, "image_raw", images.append, qos_profile_sensor_data
        )
        with ContainerProcess(arguments, tmp_path / "container.log") as container:
            container.wait_for(lambda: len(images) >= 10, 120.0, "images")
    for image in images:
        found = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width)
        np.testing.assert_array_equal(found, wanted[stamp_ns(image.header.stamp)])
        assert image.encoding == "mono8"
        assert image.header.frame_id == "sample_rig_camera_optical_frame"


def test_latencies_are_measured_for_every_frame_and_causal(played):
    run = played.results.run
    assert run.frames_sent == len(run.grid_latency_s) == len(run.wrench_latency_s) == 60
    assert (run.grid_latency_s > 0).all()
    # The wrench is computed from the grids, but another message may overtake it on its way.
    assert np.median(run.wrench_latency_s) > np.median(run.grid_latency_s)


def test_values_keep_every_limit_against_the_truth(played):
    rows = table_rows(played.results, evaluate(played.results))
    judged = {row.name: row.passed for row in rows if row.passed is not None}
    assert len(judged) == 5
    assert all(judged.values()), judged


def test_topics_carry_what_the_pipeline_computes(played, frames):
    """Wrong units, order, view or frame in a message or converter would show here."""
    pipeline = Pipeline(played.results.sensor)
    for index in (0, 31, 32):
        expected, found = pipeline.process(frames[index]), played.results.frames[index]
        for view in ("left", "right"):
            wanted, grid = getattr(expected, view), getattr(found, view)
            np.testing.assert_allclose(grid.corners_frame, wanted.corners_frame, atol=ATOL_PX)
            np.testing.assert_allclose(grid.col_lines, wanted.col_lines, atol=ATOL_PX)
            np.testing.assert_array_equal(grid.row_line_status, wanted.row_line_status)
        # The nodes triangulate from float32 pixels: 3e-5 px are 6 nm in depth.
        np.testing.assert_allclose(found.surface.position, expected.surface.position, atol=2e-8)
        np.testing.assert_allclose(found.force.position, expected.force.position, atol=ATOL_M)
        # Force follows displacement linearly: 2e-8 m of 1e-3 m.
        scale = np.abs(expected.force.force).max()
        np.testing.assert_allclose(found.force.force, expected.force.force, atol=1e-3 * scale)


def test_the_wrench_is_the_resultant_of_the_force_field(played):
    for wrench, field in zip(
        played.messages["wrench"], played.messages["force_field"], strict=True
    ):
        assert wrench.wrench == field.wrench
        total = np.frombuffer(field.force, np.float32).reshape(-1, 3).astype(np.float64).sum(axis=0)
        found = [wrench.wrench.force.x, wrench.wrench.force.y, wrench.wrench.force.z]
        np.testing.assert_allclose(found, total, atol=len(field.force) * ATOL_N)


def test_the_container_ends_cleanly_and_without_complaint(played):
    assert "Traceback" not in played.log
    assert "ERROR" not in played.log


def test_a_truncated_bag_gives_the_frames_it_has_and_one_clear_line(recording, tmp_path):
    bag = tmp_path / "cut"
    shutil.copytree(recording.bag, bag)
    (mcap,) = bag.glob("*.mcap")
    os.truncate(mcap, mcap.stat().st_size * 2 // 5)
    whole = [frame.stamp_ns for frame in BagReader(bag).frames()]
    assert 15 < len(whole) < 30
    cut = play_once(replace(recording, bag=bag), tmp_path / "container.log")
    for topic in RESULTS:
        assert [stamp_ns(m.header.stamp) for m in cut.messages[topic]] == whole
    complaints = [line for line in cut.log.splitlines() if "WARN" in line]
    assert len(complaints) == 1
    assert f"{bag}: damaged" in complaints[0]
    assert "Traceback" not in cut.log


def test_an_empty_folder_ends_the_start_with_one_line_that_names_it(tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    log = tmp_path / "container.log"
    arguments = {"input": str(empty), "sensor": "sample_rig"}
    with (
        pytest.raises(ContainerError, match=r"ended with code 1: .*found no image"),
        ContainerProcess(arguments, log) as container,
    ):
        container.wait_for(lambda: False, 60.0, "end of the container")
    errors = [line for line in log.read_text().splitlines() if str(empty) in line]
    assert len(errors) == 1
    assert errors[0].startswith("error: ")
    assert "Traceback" not in log.read_text()


def test_sigterm_while_playing_ends_all_cleanly(recording, tmp_path):
    log = tmp_path / "container.log"
    arguments = {"input": str(recording.bag), "sensor": "sample_rig", "loop": "true"}
    with Collector("/sample_rig") as collector:
        with ContainerProcess(arguments, log) as container:
            container.wait_for(lambda: collector.count("wrench") > 5, 120.0, "frames")
        assert container.exit_code == 0
    assert "Traceback" not in log.read_text()


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "cmp_tactile_bringup.command", *arguments]


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["Ctrl-C", "SIGTERM"]
)
def test_a_stopped_demo_takes_its_container_with_it(tmp_path, number, code):
    process = subprocess.Popen(
        command("demo", "--output", str(tmp_path)), stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    log = tmp_path / "container.log"
    deadline = time.monotonic() + 120
    while not (log.exists() and "components run" in log.read_text()):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    assert children
    process.send_signal(number)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == code
    assert b"Traceback" not in output
    assert not [child for child in children if Path(f"/proc/{child}").exists()]


@pytest.fixture
def short_recording(recording, frames, tmp_path):
    """Eight frames around the knock as a recording; `shift_px` makes its truth untrue."""

    def make(shift_px: float) -> Path:
        folder = tmp_path / "frames"
        folder.mkdir()
        for index in range(28, 36):
            cv2.imwrite(str(folder / f"{index}.png"), frames[index])
            np.savez(
                folder / f"{index}.npz",
                corners_left_px=recording.truth.corners_left_px[index] + (shift_px, 0.0),
                corners_right_px=recording.truth.corners_right_px[index],
                corners_m=recording.truth.corners_m[index],
            )
        bag = tmp_path / "short"
        write_recording(folder, bag, load_sensor("sample_rig"))
        (tmp_path / "short.yaml").write_text(NOTES.format(title="Eight frames around a knock"))
        return bag

    return make


@pytest.mark.parametrize(("shift_px", "code"), [(0.0, 0), (0.2, 1)], ids=["true", "untrue"])
def test_the_demo_judges_its_numbers(short_recording, tmp_path, shift_px, code):
    """From shell to page; the exit code tells whether the limits were kept."""
    bag, output = short_recording(shift_px), tmp_path / "output"
    ended = subprocess.run(
        command("demo", "--recording", str(bag), "--output", str(output)),
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert ended.returncode == code, ended.stderr
    assert ("Limits missed: Corner error, RMS" in ended.stdout) == (code == 1)
    assert "6400 of 6400" in ended.stdout
    assert {path.name for path in output.iterdir()} == {
        "index.html",
        "container.log",
        "grasp.webp",
        *(f"{name}.png" for name in PICTURES),
    }
