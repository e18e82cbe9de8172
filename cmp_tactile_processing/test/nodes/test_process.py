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

from cmp_tactile_processing.ros.process import JoinError, Listener

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


@pytest.mark.parametrize(
    ("node", "parameter", "reason"),
    [
        ("view_splitter", "sensor_description:=nowhere.yaml", "nowhere.yaml: found no such file"),
        ("gridline_tracker", "view:=top", "view: found 'top', expected one of left, right"),
        ("force_reconstructor", "contact_pressure_floor:=-1.0", "found -1.0, expected at least"),
    ],
)
def test_wrong_parameter_is_one_line_and_exit_code_one(node, parameter, reason):
    process = _start(node, "-p", parameter)
    try:
        _, errors = process.communicate(timeout=START_TIMEOUT_S)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 1
    lines = errors.strip().splitlines()
    assert len(lines) == 1, errors
    assert lines[0].startswith("error: ")
    assert reason in lines[0]


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


def test_interrupt_that_a_finaliser_swallows_comes_again():
    """Python drops what is raised in __del__; a compiler runs many, and used to eat Ctrl-C."""
    code = """
import os, signal, sys, time
from cmp_tactile_processing.ros.process import run_node

class Finaliser:
    def __del__(self):
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)
        except KeyboardInterrupt:
            print("lost one", file=sys.stderr)
            raise

def make_node():
    Finaliser()
    time.sleep(60)

sys.exit(run_node(make_node))
"""
    process = subprocess.run(
        [sys.executable, "-c", code],
        stderr=subprocess.PIPE,
        text=True,
        timeout=END_TIMEOUT_S,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    assert process.stderr == "lost one\n"


def test_missing_security_is_reported_in_one_line(tmp_path):
    """With the wheels' Fast DDS, which has none, and with keys that are none."""
    enclave = tmp_path / "enclaves"
    enclave.mkdir()
    for name in ("identity_ca.cert", "cert", "key", "permissions_ca.cert"):
        (enclave / f"{name}.pem").write_text("none")
    for name in ("governance", "permissions"):
        (enclave / f"{name}.p7s").write_text("none")
    security = {
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ROS_SECURITY_KEYSTORE": str(tmp_path),
    }
    done = subprocess.run(
        [sys.executable, "-m", "cmp_tactile_processing.nodes.view_splitter"],
        env={**os.environ, **security},
        capture_output=True,
        text=True,
        check=False,
    )
    errors = [line for line in done.stderr.splitlines() if "[INFO]" not in line]
    assert done.returncode == 1
    assert len(errors) == 1
    assert errors[0].startswith("error: ROS_SECURITY_ENABLE=true: found no secure")


@pytest.mark.parametrize("domain", ["abc", "-1", "5.5", "233"])
def test_a_domain_that_is_none_is_named(monkeypatch, domain):
    """Reports: ros2/rmw_cyclonedds 61, ros2/rcl 694, strands-labs/robots 1976.

    Tried: nodes of domain -1 ran in domain 0, those of 5.5 in 5; 233 was an error of Fast DDS with
    a traceback.
    """
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    with pytest.raises(JoinError, match=f"ROS_DOMAIN_ID: found '{domain}', expected .* 0 to 232"):
        Listener("somebody").__enter__()
