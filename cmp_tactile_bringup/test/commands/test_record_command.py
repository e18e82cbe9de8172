"""`cmp_tactile record` beside the nodes of a sensor, as a process of its own."""

import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import made_bags
import pytest
from command_output import run
from documents import assert_printed, shown_after
from ros_graph import header_at

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import Image

from cmp_tactile_bringup.commands import running
from cmp_tactile_bringup.recordings.library import required_sensor
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_driver.bags.storage import BagStorage
from cmp_tactile_processing.nodes.view_splitter import ViewSplitter
from cmp_tactile_processing.ros.messages.conversions import frame_to_msg
from cmp_tactile_processing.sensor.description import load_sensor

COMMAND = [sys.executable, "-m", "cmp_tactile_bringup.command", "record"]
TIMEOUT_S = 90.0
TUTORIAL = Path(__file__).resolve().parents[3] / "docs" / "tutorials" / "record_replay.md"
NOBODY = ": no node published it"
SHOWN_AFTER = "cmp_tactile record --output my_bag --duration 10"


def test_a_running_sensor_is_found_and_recorded(ros, tmp_path):
    """Its namespace and its description are those of the nodes that run."""
    ros.start(ViewSplitter, sensor_name="thumb")
    images = ros.node.create_publisher(Image, "image_raw", 10)
    wrenches = ros.node.create_publisher(WrenchStamped, "wrench", 10)
    statuses = ros.statuses("recorder")
    bag = tmp_path / "my_bag"
    command = [*COMMAND, "-o", bag.name, "--namespace", ros.namespace, "--compression", "png"]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=tmp_path, **pipes) as process:
        try:
            ros.wait(lambda: images.get_subscription_count() == 2, "the recorder", TIMEOUT_S)
            ros.wait(wrenches.get_subscription_count, "the recorder", TIMEOUT_S)
            for number, frame in enumerate(made_bags.frames(5, 768, 1024)):
                images.publish(frame_to_msg(frame, header_at(number * 10**9)))
                wrenches.publish(WrenchStamped())
            # Both of every frame, and the transforms.
            ros.wait(lambda: statuses.values.get("messages") == "11", "all in the bag", TIMEOUT_S)
        finally:
            process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0, err
    assert f"       5  {ros.namespace}/image_raw/compressed\n" in out
    assert f"       5  {ros.namespace}/wrench\n" in out
    assert f"       0  {ros.namespace}/force_field: no node published it\n" in out
    assert [item.stamp_ns for item in BagReader(bag).frames()] == [n * 10**9 for n in range(5)]
    assert "/tf_static" in BagStorage(bag).topics
    # How many there are, and so their order, depends on who publishes and on the machine.
    printed = out.replace(ros.namespace, "/sample_rig").replace("/compressed", "")
    for line in shown_after(TUTORIAL, SHOWN_AFTER):
        topic = line.removesuffix(NOBODY)
        assert_printed([topic], printed.replace(NOBODY, ""), absolute=1e9, whole=False)
    # What a replay of it takes for its sensor.
    assert required_sensor(bag, None) == str(bag / "sensor.yaml")
    assert load_sensor(str(bag / "sensor.yaml")).name == "thumb"


@pytest.mark.usefixtures("own_signals")
def test_no_sensor_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(running, "SEARCH_TIME_S", 0.3)
    bag = tmp_path / "bag"
    assert run("record", "-o", bag, "--namespace", "nobody_has_this") == 1
    error = capsys.readouterr().err
    assert error.startswith("error: found no running sensor in /nobody_has_this")
    assert error.count("\n") == 1
    assert not bag.exists()
