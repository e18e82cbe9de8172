"""A graph in containers that launch starts, or that are there; needs a ROS with launch."""

import importlib.util
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

# Not marked `ros`: where ROS 2 is required, launch is not.
pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("launch_ros") is None, reason="launch_ros is not installed"
)

from composition_interfaces.srv import ListNodes
from std_msgs.msg import String

TIMEOUT_S = 120.0
GRAPH = '''
from cmp_tactile_bringup.graphs.description import Argument, Component, graph

@graph(Argument("prefix", "what is put before", "heard"))
def mine(given):
    """Two components."""
    parameters = {"prefix": given["prefix"], "numbers": [1.0, 2.0]}
    renamed = {"in": "question", "out": "answer"}
    package = "sample_components"
    return [
        Component(package, f"{package}::Echo", "echo", "NAMESPACE", renamed, parameters),
        Component(package, f"{package}::Ticker", "ticker", "NAMESPACE"),
    ]
'''


@pytest.fixture
def graph(ros, tmp_path) -> Path:
    path = tmp_path / "graph.py"
    path.write_text(GRAPH.replace("NAMESPACE", ros.namespace))
    return path


def _loaded(ros: Any, container: str = "box") -> list[str]:
    service = f"{ros.namespace}/{container}/_container/list_nodes"
    names = ros.call(ListNodes, service, ListNodes.Request(), TIMEOUT_S).full_node_names
    return [name.removeprefix(ros.namespace) for name in names]


def _end(process: subprocess.Popen[str], number: signal.Signals) -> tuple[int, str]:
    process.send_signal(number)
    log = process.communicate(timeout=TIMEOUT_S)[0]
    return process.returncode, log


def _wait_for_line(process: subprocess.Popen[str], text: str) -> None:
    assert process.stdout is not None
    log = ""
    for line in process.stdout:
        log += line
        if text in line:
            return
    pytest.fail(f"ended without {text!r}: {log}")


# What `ros2 launch` does with a launch file and its arguments.
LAUNCH = """
import sys
from launch import LaunchDescription, LaunchDescriptionSource, LaunchService
from launch.actions import IncludeLaunchDescription
from cmp_tactile_bringup.graphs.launch import launch_description
service = LaunchService(argv=sys.argv[2:], noninteractive=True)
service.include_launch_description(LaunchDescription([IncludeLaunchDescription(
    LaunchDescriptionSource(launch_description(sys.argv[1])),
    launch_arguments=[word.split(":=") for word in sys.argv[2:]])]))
sys.exit(service.run())
"""


def test_launch_starts_a_container_and_ends_with_zero(ros, start, graph):
    answers = ros.listen(String, "answer")
    runner = start("-c", LAUNCH, str(graph), "prefix:=yes ")
    publisher = ros.publisher(String, "question")
    publisher.publish(String(data="there?"))
    ros.wait(lambda: answers, "the answer", TIMEOUT_S)
    assert answers[0].data == "yes there?"
    # Launch does not bear an end while it waits for an answer.
    _wait_for_line(runner, f"Loaded node '{ros.namespace}/ticker'")
    assert _loaded(ros, "tactile_container") == ["/echo", "/ticker"]
    # SIGTERM ends launch itself at once and leaves its processes behind.
    code, log = _end(runner, signal.SIGINT)
    assert (code, "Traceback" in log) == (0, False), log
    assert "process has finished cleanly" in log


def test_launch_loads_into_a_container_that_is_there(ros, start, container, graph):
    ticks = ros.listen(String, "ticks")
    runner = start("-c", LAUNCH, str(graph), f"container:={ros.namespace}/box")
    ros.wait(lambda: ticks, "ticks", TIMEOUT_S)
    _wait_for_line(runner, f"Loaded node '{ros.namespace}/ticker'")
    assert _end(runner, signal.SIGINT)[0] == 0
    # As with every launch file, they stay.
    assert _loaded(ros) == ["/echo", "/ticker"]
    assert _end(container, signal.SIGTERM)[0] == 0
