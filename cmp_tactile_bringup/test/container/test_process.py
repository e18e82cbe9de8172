"""The executable component_container ends with 0 at a signal, whatever its components do."""

from __future__ import annotations

import itertools
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from composition_interfaces.srv import LoadNode
from rclpy.parameter import Parameter

SAMPLES = Path(__file__).parents[1] / "sample_components"
TIMEOUT_S = 60.0


class Process:
    """component_container in a process of its own, named as launch names it."""

    def __init__(self, ros: Any) -> None:
        self._ros = ros
        path = os.pathsep.join([str(SAMPLES), os.environ.get("PYTHONPATH", "")])
        names = ["-r", "__node:=box", "-r", f"__ns:={ros.namespace}"]
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "cmp_tactile_bringup.container.executables",
                "component_container",
                "--ros-args",
                *names,
            ],
            env={**os.environ, "PYTHONPATH": path},
            stderr=subprocess.PIPE,
            text=True,
        )

    def load_later(self, plugin: str, name: str, **parameters: Any) -> Any:
        request = LoadNode.Request(
            package_name="sample_components",
            plugin_name=f"sample_components::{plugin}",
            node_name=name,
            parameters=[Parameter(k, value=v).to_parameter_msg() for k, v in parameters.items()],
        )
        return self._ros.call_later(LoadNode, "box/_container/load_node", request)

    def load(self, plugin: str, name: str, **parameters: Any) -> None:
        future = self.load_later(plugin, name, **parameters)
        self._ros.wait(future.done, f"{name} to be loaded")
        assert future.result().success, future.result().error_message

    def wait_for_node(self, name: str) -> None:
        """Until a node is there; its constructor may still be at work."""
        self._ros.wait(lambda: name in self._ros.node.get_node_names(), f"the node {name}")

    def end(self, number: signal.Signals) -> tuple[int, str]:
        """Exit code after the signal, and what was written to stderr."""
        self._process.send_signal(number)
        return self.outcome()

    def outcome(self) -> tuple[int, str]:
        """Exit code, and what was written to stderr."""
        log = self._process.communicate(timeout=TIMEOUT_S)[1]
        return self._process.returncode, log

    def close(self) -> None:
        self._process.kill()
        self._process.wait()


@pytest.fixture
def process(ros) -> Iterator[Process]:
    process = Process(ros)
    yield process
    process.close()


def test_signal_while_components_are_busy(process):
    for k in range(4):
        process.load("Ticker", f"ticker_{k}")
    code, log = process.end(signal.SIGINT)
    assert code == 0, log
    assert "Traceback" not in log
    assert "terminate called" not in log


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


def test_a_component_that_ends_the_ros_context_ends_the_container(process):
    process.load("Ticker", "ticker")
    process.load("EndsRos", "ends_ros")
    code, log = process.outcome()
    assert code == 0, log
    assert "Traceback" not in log


def test_signal_while_a_constructor_and_a_callback_do_not_end(process):
    process.load("Ticker", "ticker")
    process.load("Sticks", "sticks", seconds=60.0)
    process.load_later("Slow", "slow", seconds=60.0)
    process.wait_for_node("slow")
    code, log = process.end(signal.SIGTERM)
    assert code == 0, log
    (left,) = re.findall(r"left behind: (.*)", log)
    assert "/sticks" in left
    assert "a component that is being built" in left
    assert "/ticker" not in left
    assert "Traceback" not in log
