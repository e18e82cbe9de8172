"""The examples of the documentation run and tell the truth."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from cmp_tactile_simulation.recorded_truth import read_truth

EXAMPLES = Path(__file__).resolve().parent.parent / "docs" / "examples"


@pytest.mark.usefixtures("short_scenes")
def test_offline_example_prints_the_grasp(grasp_bag):
    run = subprocess.run(
        [sys.executable, str(EXAMPLES / "offline.py")], capture_output=True, text=True, check=True
    )
    rows = [[float(item) for item in line.split()] for line in run.stdout.splitlines()[1:]]
    assert [row[0] for row in rows] == [0, 5, 10, 15]
    wrench = read_truth(grasp_bag).wrench
    for number, corners, deepest, *force in rows:
        true = wrench[int(number), :3]
        assert corners == 400
        assert (deepest > 0.1) == (number > 0)
        # What the force stage reaches on another mesh than the simulator's, and noise.
        assert force == pytest.approx(true, abs=0.1 * abs(true[2]) + 0.1)


def test_refraction_example_prints_what_the_documentation_says():
    run = subprocess.run(
        [sys.executable, str(EXAMPLES / "refraction.py")],
        capture_output=True,
        text=True,
        check=True,
    )
    rows = [[float(item) for item in line.split()[-5:]] for line in run.stdout.splitlines()[2:]]
    document = (EXAMPLES.parent / "optics.md").read_text(encoding="utf-8")
    table = re.findall(r"^\| (?:all|none).*", document, re.MULTILINE)
    assert len(rows) == len(table) == 3
    for row, line in zip(rows, table, strict=True):
        told = [float(item) for item in re.findall(r"(-?[\d.]+) um", line)]
        # Told to three digits or so.
        assert row == pytest.approx(told, rel=0.02, abs=0.006)


def test_the_drawing_of_the_mirrors_is_made(tmp_path):
    script = EXAMPLES.parent / "drawings" / "mirror_views.py"
    picture = tmp_path / "mirror_views.png"
    subprocess.run([sys.executable, str(script), str(picture)], check=True)
    drawn, kept = (
        cv2.imread(str(path)) for path in (picture, EXAMPLES.parent / "images" / picture.name)
    )
    assert drawn.shape == kept.shape
    # Another matplotlib may set its letters a little differently.
    assert np.abs(drawn.astype(float) - kept).mean() < 2


def test_the_washer_of_the_tutorial_is_simulated_and_felt(tmp_path):
    """Up to the end of the press, coarser and in fewer samples, as the tutorial's commands do."""
    scene = (EXAMPLES / "washer" / "washer.yaml").read_text(encoding="utf-8")
    coarse = scene + "contact_nodes: 21\nsamples: 2\n"
    (tmp_path / "washer.yaml").write_text(coarse, encoding="utf-8")
    shutil.copy(EXAMPLES / "washer" / "washer.stl", tmp_path)
    bag = tmp_path / "recording"
    command = ["cmp_tactile", "simulate", tmp_path / "washer.yaml", "--output", bag, "--video"]
    subprocess.run([*command, "--frames", "21"], check=True, capture_output=True)
    assert (bag / "video.mp4").stat().st_size > 10_000
    run = subprocess.run(
        [sys.executable, EXAMPLES / "compare.py", bag], capture_output=True, text=True, check=True
    )
    rows = [[float(item) for item in line.split()] for line in run.stdout.splitlines()[1:]]
    assert [row[0] for row in rows] == [0, 5, 10, 15, 20]
    for _, corners_px, surface_um, found, true, *_ in rows:
        # The detector's noise at this sensor's blur, and what it makes in depth.
        assert corners_px < 0.05
        assert surface_um < 5
        assert found == pytest.approx(true, abs=0.1 * abs(true) + 0.1)
    assert rows[-1][4] == pytest.approx(-4, abs=0.01)


@pytest.mark.ros
def test_listening_example_tells_of_a_grip():
    rclpy = pytest.importorskip("rclpy")
    from cmp_tactile_msgs.msg import ForceField

    context = rclpy.Context()
    context.init()
    node = rclpy.create_node("test_listening_example", context=context)
    publisher = node.create_publisher(ForceField, "/finger/force_field", 10)
    listener = subprocess.Popen(
        [sys.executable, str(EXAMPLES / "listen.py"), "finger"],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "ROS_DOMAIN_ID": str(context.get_domain_id())},
    )
    try:
        deadline = time.monotonic() + 20
        while publisher.get_subscription_count() == 0 and time.monotonic() < deadline:
            time.sleep(0.05)
        for fz in (-1.0, -7.5, -8.0, -0.5):
            msg = ForceField(contact_area=60e-6)
            msg.wrench.force.z = fz
            publisher.publish(msg)
        said = [listener.stdout.readline() for _ in range(2)]
        listener.send_signal(signal.SIGINT)
        assert listener.wait(timeout=10) == 0
    finally:
        listener.kill()
        listener.stdout.close()
        node.destroy_node()
        context.try_shutdown()
    assert said == ["grip firm: 7.5 N over 60 mm2\n", "grip loose: 0.5 N over 60 mm2\n"]


@pytest.mark.ros
@pytest.mark.usefixtures("short_scenes")
def test_the_example_that_moves_the_indenter_feels_what_is_true(tmp_path):
    """Against `cmp_tactile live`, as the tutorial tells to run it."""
    log = (tmp_path / "live.log").open("w")
    live = subprocess.Popen(
        [sys.executable, "-m", "cmp_tactile_bringup.command", "live", "grasp", "--no-autoplay"],
        stdout=log,
        stderr=subprocess.STDOUT,
    )
    try:
        hand = subprocess.run(
            [sys.executable, str(EXAMPLES / "move_indenter.py"), "sample_rig"],
            capture_output=True,
            text=True,
            timeout=400,
            check=False,
        )
        live.send_signal(signal.SIGINT)
        assert live.wait(timeout=60) == 0
    finally:
        live.kill()
        log.close()
    told = (tmp_path / "live.log").read_text()
    assert hand.returncode == 0, hand.stderr + told
    assert "Traceback" not in told
    lines = hand.stdout.splitlines()
    assert [line.split()[0] for line in lines] == ["pressed", "dragged", "released"]
    forces = {}
    for line in lines:
        felt, true = (
            [float(number) for number in part.split(",")] for part in re.findall(r"\((.*?)\)", line)
        )
        # What the force stage reaches on another mesh than the simulator's, and noise.
        assert felt == pytest.approx(true, abs=0.1 * abs(true[2]) + 0.1)
        forces[line.split()[0]] = true
    assert forces["pressed"] == pytest.approx([0, 0, -2], abs=0.03)
    assert forces["dragged"][0] > 0.3
    assert forces["released"] == [0, 0, 0]
