"""The driver's nodes report in /diagnostics as the stages do."""

from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from rclpy.parameter import Parameter

from cmp_tactile_driver.nodes.camera_driver import CameraDriver
from cmp_tactile_driver.nodes.recorder import Recorder
from cmp_tactile_driver.nodes.replay import Replay
from cmp_tactile_processing.ros.diagnostics import StageDiagnostics

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
    start(name)
    ros.wait(lambda: last(name)[1], "a report")
    status, values = last(name)
    assert status.hardware_id == "finger"
    assert {"state", "rate (Hz)", "problem"} <= values.keys()
    own = {"messages", "dropped"} if name == "recorder" else {"frames out", "bad frames"}
    assert own <= values.keys()
    stage, _ = StageDiagnostics().report()
    for key in values:
        if key.startswith(("rate", "latency", "frames")):
            assert key in stage
    document = DOCUMENT.read_text(encoding="utf-8")
    assert [key for key in values if f"`{key}`" not in document] == []


@pytest.mark.parametrize("name", NODES)
def test_parameters_are_refused_with_the_reason_and_unknown_ones_reported(ros, start, capfd, name):
    node = start(name, sensor_nam="x")
    reported = node.set_parameters_atomically([Parameter("sensor_name", value="y")])
    assert "read-only" in reported.reason
    if name != "camera_driver":  # which reports once its source is open, and it is not
        text = "sensor_nam: no such parameter; did you mean 'sensor_name'? (given at the start"
        assert text in capfd.readouterr().err
