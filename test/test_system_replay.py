"""The demo: a bag through the container, in a process of its own, over real DDS topics.

That topics carry what `Pipeline` gives: cmp_tactile_processing/test/nodes/test_chain.py.
"""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from waiting import wait_until

from cmp_tactile_bringup.command import main

# With other tests beside it, frames are sent later, and none is lost.
pytestmark = pytest.mark.ros

PICTURES = ("overview", "wrench", "contacts")
FRAMES = 20


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
    log = (output / "container.log").read_text()
    assert "Traceback" not in log
    assert "ERROR" not in log
    corners = FRAMES * 2 * 20 * 20
    assert f"{corners} of {corners}" in printed
    assert {path.name for path in output.iterdir()} == {
        "index.html",
        "container.log",
        *(f"{name}.png" for name in PICTURES),
    }
