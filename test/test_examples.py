"""The examples of the documentation run and tell the truth."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parent.parent / "docs" / "examples"


def test_offline_example_prints_the_grasp():
    run = subprocess.run(
        [sys.executable, str(EXAMPLES / "offline.py")], capture_output=True, text=True, check=True
    )
    rows = [[float(item) for item in line.split()] for line in run.stdout.splitlines()[1:]]
    assert [row[0] for row in rows] == list(range(0, 60, 5))
    for number, corners, deepest, fx, _, fz in rows:
        assert corners == 400
        if number in (0, 5):
            assert deepest < 0.02
            assert abs(fz) < 0.1
        if number == 30:
            # Pressed in by 1 mm and dragged along +x, by how the recording was made.
            assert deepest == pytest.approx(1.0, abs=0.02)
            assert fz < -1
            assert fx > 1
        if number == 35:
            # Knocked to the other side.
            assert fx < -1


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
