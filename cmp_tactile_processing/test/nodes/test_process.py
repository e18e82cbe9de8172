"""Each node as a process of its own: ends cleanly on a signal, explains why it cannot start."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip("rclpy")

from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters

from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.ros.process import Listener

pytestmark = pytest.mark.ros

START_TIMEOUT_S = 60.0
END_TIMEOUT_S = 60.0


def _start(node: str, *arguments: str, **environment: str) -> subprocess.Popen:
    module = f"cmp_tactile_processing.nodes.{node}"
    return subprocess.Popen(
        [sys.executable, "-m", module, "--ros-args", *arguments],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | environment,
    )


# All nodes are run by the same function; one of these is long in building.
@pytest.mark.parametrize(
    ("node", "number"),
    [
        ("view_splitter", signal.SIGINT),
        ("view_splitter", signal.SIGHUP),
        ("force_reconstructor", signal.SIGTERM),
    ],
)
def test_signal_ends_the_process_with_zero(ros, tmp_path, node, number):
    """Also while the force model is being built: its cache is empty here."""
    process = _start(
        node,
        "-r",
        f"__ns:={ros.namespace}",
        "-p",
        "sensor_description:=sample_rig",
        XDG_CACHE_HOME=str(tmp_path),
    )
    try:
        publishers = f"{ros.namespace}/{node}"
        ros.wait(
            lambda: any(
                f"{namespace}/{name}" == publishers
                for name, namespace in ros.node.get_node_names_and_namespaces()
            ),
            f"{node} to start",
            START_TIMEOUT_S,
        )
        time.sleep(0.3)
        process.send_signal(number)
        if number == signal.SIGHUP:
            # As a shell and then the kernel do.
            time.sleep(0.005)
            process.send_signal(number)
        _, errors = process.communicate(timeout=END_TIMEOUT_S)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0, errors
    assert "Traceback" not in errors


def _why_not_started(process: subprocess.Popen) -> str:
    try:
        _, errors = process.communicate(timeout=START_TIMEOUT_S)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 1
    return errors


@pytest.mark.parametrize(
    ("node", "parameter", "reason"),
    [
        ("view_splitter", "sensor_description:=nowhere.yaml", "nowhere.yaml: found no such file"),
        ("gridline_tracker", "view:=top", "view: found 'top', expected one of left, right"),
        ("force_reconstructor", "contact_pressure_floor:=-1.0", "found -1.0, expected at least"),
    ],
)
def test_wrong_parameter_is_one_line_and_exit_code_one(node, parameter, reason):
    errors = _why_not_started(_start(node, "-p", parameter))
    lines = errors.strip().splitlines()
    assert len(lines) == 1, errors
    assert lines[0].startswith("error: ")
    assert reason in lines[0]


@pytest.mark.parametrize("home", ["", "/dev/null"])
def test_ros_needs_no_home(home):
    """Tried: "Failed to get logging directory".  As in ros2/rcl_logging 72, psf/black 2813."""
    parameter = ("-p", "sensor_description:=nowhere.yaml")
    process = _start("view_splitter", *parameter, HOME=home, ROS_HOME="", ROS_LOG_DIR="")
    assert "found no such file" in _why_not_started(process)


def test_a_callback_that_raises_does_not_end_the_others():
    """ROS's own raise at a request of an unknown type; tried: that ended every node by itself.

    Reports: ros2/rclcpp 3257, Karsten1987/confbot_robot 28, ros-controls/ros2_controllers 136.
    """
    with Listener("asked") as asked:
        odd = Parameter(name="use_sim_time", value=ParameterValue(type=255))
        for request in (SetParameters.Request(parameters=[odd]), SetParameters.Request()):
            client = asked.node.create_client(SetParameters, "/asked/set_parameters")
            assert client.wait_for_service(START_TIMEOUT_S)
            answer = client.call_async(request)
        end = time.monotonic() + END_TIMEOUT_S
        while not answer.done() and time.monotonic() < end:
            time.sleep(0.01)
        assert answer.done()


SECURITY = {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce"}


@pytest.mark.parametrize(
    ("variable", "value", "others"),
    [
        *(("ROS_DOMAIN_ID", domain, {}) for domain in ("abc", "-1", "5.5", "9999")),
        ("ROS_LOG_DIR", "/dev/null", {}),
        ("ROS_HOME", "/dev/null", {"ROS_LOG_DIR": ""}),
        ("ROS_SECURITY_KEYSTORE", "", SECURITY),
    ],
)
def test_why_ros_cannot_be_joined_is_one_line(monkeypatch, variable, value, others):
    """Reports: ros2/rmw_fastrtps 261, ros2/rmw_cyclonedds 61, eProsima/Fast-DDS 6472 (domains);
    osrf/car_demo 59, ros/ros_comm 1063 (log folder); ros2/sros2 116 (no keystore).
    """
    for name, text in {variable: value, **others}.items():
        monkeypatch.setenv(name, text)
    with pytest.raises(
        CmpTactileError, match=f"^{variable}: found .*{value}.*, expected"
    ) as raised:
        Listener("somebody").__enter__()
    assert "\n" not in str(raised.value)


def test_a_listener_takes_the_arguments_of_ros_and_leaves_ours(monkeypatch, capfd):
    """rcl warned of `live slip view:=true`: "Found remap rule ... This syntax is deprecated"."""
    arguments = ["live", "view:=true", "--ros-args", "-r", "__node:=other", "--", "record:=bag"]
    monkeypatch.setattr("sys.argv", ["cmp_tactile", *arguments])
    with Listener("listener") as listener:
        assert listener.node.get_name() == "other"
    assert "deprecated" not in capfd.readouterr().err
