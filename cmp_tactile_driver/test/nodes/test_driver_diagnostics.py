"""The driver's nodes report in /diagnostics as the stages do."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image

from cmp_tactile_driver.nodes.camera_driver import CameraDriver
from cmp_tactile_driver.nodes.recorder import Recorder
from cmp_tactile_driver.nodes.replay import Replay
from cmp_tactile_processing.ros.diagnostics.stage import StageDiagnostics
from cmp_tactile_processing.ros.diagnostics.status import DIAGNOSTICS_PERIOD_S

pytestmark = pytest.mark.ros

DOCUMENT = Path(__file__).parents[3] / "docs" / "diagnostics.md"
NODES = {"camera_driver": CameraDriver, "replay": Replay, "recorder": Recorder}


@pytest.fixture
def start(ros, image_folder, tmp_path):
    """Starts a node of the driver, by name, that can work."""
    given = {
        "camera_driver": {"input": str(image_folder)},
        "replay": {"input": str(image_folder), "loop": True},
        "recorder": {"output": str(tmp_path / "bag")},
    }

    def start_node(name, **parameters):
        return ros.start(NODES[name], sensor_name="finger", **{**given[name], **parameters})

    return start_node


@pytest.fixture
def last(ros):
    """The last status of a node, and its values."""
    reports = {name: ros.reports(name) for name in NODES}
    return lambda name: (reports[name].last, reports[name].values)


@pytest.mark.parametrize("name", NODES)
def test_name_hardware_and_keys_are_those_of_every_node(ros, start, last, name):
    """What follows or plots a figure finds it under the same key in the whole chain."""
    node = start(name)
    ros.wait(lambda: last(name)[1], "a report")
    status, values = last(name)
    assert status.hardware_id == "finger"
    assert {"state", "rate (Hz)", "wrong connections", "problem"} <= values.keys()
    own = {"messages", "dropped"} if name == "recorder" else {"frames out", "bad frames"}
    assert own <= values.keys()
    for key in values:
        if key.startswith(("rate", "latency", "late", "frames")):
            assert key in _stage_keys()
    assert node.get_parameter("diagnostics.report_after").value == 2
    document = DOCUMENT.read_text(encoding="utf-8")
    assert [key for key in values if f"`{key}`" not in document] == []


def _stage_keys() -> set[str]:
    return set(StageDiagnostics().report().values)


@pytest.mark.parametrize("name", ["replay", "recorder"])
def test_a_rate_below_its_threshold_is_reported_while_the_node_works(ros, start, last, name):
    at_once = {"diagnostics.report_after": 1, "diagnostics.clear_after": 1}
    node = start(name, **{"diagnostics.rate_warn": 1000.0, **at_once})
    ros.wait(lambda: "results a second, expected 1000" in last(name)[0].message, "the rate")
    assert last(name)[0].level == DiagnosticStatus.WARN
    assert node.set_parameters([Parameter("diagnostics.rate_warn", value=0.0)])[0].successful
    ros.wait(lambda: "expected 1000" not in last(name)[0].message, "the new threshold")


@pytest.mark.parametrize("name", ["replay", "camera_driver"])
def test_who_gets_no_frames_is_reported(ros, start, last, name):
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    ros.node.create_subscription(Image, "image_raw", print, latched)
    start(name)
    space = ros.namespace
    text = f"{space}/image_raw: no message from {space}/{name} reaches {space}/tester: "
    ros.wait(lambda: text in last(name)[1].get("wrong connections", ""), "it")
    assert text in last(name)[0].message


@pytest.mark.parametrize("name", NODES)
def test_parameters_are_refused_with_the_reason_and_unknown_ones_reported(ros, start, capfd, name):
    node = start(name, sensor_nam="x")
    reported = node.set_parameters_atomically([Parameter("sensor_name", value="y")])
    assert "it is fixed at the start" in reported.reason
    reported = node.set_parameters_atomically([Parameter("diagnostics.late_warn", value=2.0)])
    assert reported.reason == "diagnostics.late_warn: found 2.0, expected 0 to 1"
    if name != "camera_driver":  # which reports once its source is open, and it is not
        text = "sensor_nam: no such parameter; did you mean sensor_name? (given at the start"
        assert text in capfd.readouterr().err


def test_two_reports_at_once_are_one_period(ros, start, last):
    """A change of state is reported at once, with too few frames for a rate."""
    node = start("replay")
    ros.wait(lambda: last("replay")[1], "a report")
    ros.run(1.2 * DIAGNOSTICS_PERIOD_S)
    rate = float(last("replay")[1]["rate (Hz)"])
    node.reporter.publish()
    node.reporter.publish()
    ros.run(0.1)
    assert float(last("replay")[1]["rate (Hz)"]) > 0.3 * rate > 0
