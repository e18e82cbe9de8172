"""The executable component_container ends with 0 at a signal, whatever its components do."""

import itertools
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from composition_interfaces.srv import LoadNode
from rclpy.parameter import Parameter

TIMEOUT_S = 60.0


def _load_later(ros: Any, plugin: str, name: str, **parameters: Any) -> Any:
    request = LoadNode.Request(
        package_name="sample_components",
        plugin_name=f"sample_components::{plugin}",
        node_name=name,
        parameters=[Parameter(k, value=v).to_parameter_msg() for k, v in parameters.items()],
    )
    return ros.call_later(LoadNode, "box/_container/load_node", request)


def _load(ros: Any, plugin: str, name: str, **parameters: Any) -> None:
    future = _load_later(ros, plugin, name, **parameters)
    ros.wait(future.done, f"{name} to be loaded")
    assert future.result().success, future.result().error_message


def _outcome(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code, and what was written."""
    log = process.communicate(timeout=TIMEOUT_S)[0]
    return process.returncode, log


def _handles_signals(pid: int) -> bool:
    """Whether its own handlers are there; before, Python itself is being started."""
    status = Path(f"/proc/{pid}/status").read_text()
    (caught,) = re.findall(r"SigCgt:\s+(\w+)", status)
    return bool(int(caught, 16) >> (signal.SIGTERM - 1) & 1)


def test_signals_at_any_moment_of_start_and_end():
    """While it imports, starts, waits and ends; as a terminal and launch send several of them."""
    namespace = f"/process_test_{os.getpid()}"
    command = [sys.executable, "-m", "cmp_tactile_bringup.container.executables"]
    command += ["component_container", "--ros-args"]
    moments = {}
    for delay in (0.0, 0.5, 1.0, 2.0):
        process = subprocess.Popen(
            [*command, "-r", f"__ns:={namespace}"], stderr=subprocess.PIPE, text=True
        )
        while not _handles_signals(process.pid):
            time.sleep(0.005)
        moments[process] = time.monotonic() + delay
    waiting, number = dict(moments), itertools.cycle((signal.SIGINT, signal.SIGTERM))
    while any(process.poll() is None for process in waiting):
        for process, moment in waiting.items():
            if time.monotonic() > moment and process.poll() is None:
                process.send_signal(next(number))
        time.sleep(0.01)
        assert time.monotonic() < max(moments.values()) + TIMEOUT_S, "a process does not end"
    for process in moments:
        log = process.communicate()[1]
        assert process.returncode == 0, log
        assert "Traceback" not in log


def test_a_component_that_ends_the_ros_context_ends_the_container(ros, container):
    _load(ros, "Ticker", "ticker")
    _load(ros, "EndsRos", "ends_ros")
    code, log = _outcome(container)
    assert code == 0, log
    assert "Traceback" not in log


def test_signal_while_a_constructor_and_a_callback_do_not_end(ros, container):
    _load(ros, "Ticker", "ticker")
    _load(ros, "Sticks", "sticks", seconds=60.0)
    _load_later(ros, "Slow", "slow", seconds=60.0)
    # The node is there while its constructor is still at work.
    ros.wait(lambda: "slow" in ros.node.get_node_names(), "the node slow")
    container.send_signal(signal.SIGTERM)
    code, log = _outcome(container)
    assert code == 0, log
    (left,) = re.findall(r"still busy after .*?: (.*)", log)
    assert "/sticks" in left
    assert "a component that is being built" in left
    assert "/ticker" not in left
    assert "Traceback" not in log
