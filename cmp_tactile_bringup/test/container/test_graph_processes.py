"""A graph in processes of its own: by launch, or by `standalone` in a container that is there."""

from __future__ import annotations

import importlib.util
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

import rclpy
from composition_interfaces.srv import ListNodes
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import String

from cmp_tactile_bringup.container.graph_runner import ContainerClient, StoppedError
from cmp_tactile_bringup.errors import ComponentLoadError
from cmp_tactile_processing.ros.diagnostics import graph_watch
from cmp_tactile_processing.ros.diagnostics.graph_watch import NamesInUse, times_named

SAMPLES = Path(__file__).parents[1] / "sample_components"
TIMEOUT_S = 120.0
EXECUTABLES = "cmp_tactile_bringup.container.executables"
GRAPH = '''
from cmp_tactile_bringup.graphs.description import Argument
from cmp_tactile_bringup.graphs.description import Component, graph

@graph(Argument("prefix", "text", "what is put before", "heard"), container="not_this_one")
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


@pytest.mark.ros
def test_components_live_there_until_a_signal(ros, start, container, graph):
    answers = ros.listen(String, "answer")
    runner = start(
        "-m",
        EXECUTABLES,
        "standalone",
        str(graph),
        "prefix:=yes ",
        f"container:={ros.namespace}/box",
    )
    publisher = ros.publisher(String, "question")
    publisher.publish(String(data="there?"))
    ros.wait(lambda: answers, "the answer", TIMEOUT_S)
    assert answers[0].data == "yes there?"
    ros.wait(lambda: _loaded(ros) == ["/echo", "/ticker"], "both components", TIMEOUT_S)
    code, log = _end(runner, signal.SIGINT)
    assert (code, "Traceback" in log) == (0, False), log
    # The container goes on without them.
    ros.wait(lambda: _loaded(ros) == [], "an empty container", TIMEOUT_S)
    # A component that is refused takes the others along.
    text = graph.read_text()
    graph.write_text(text.replace("::Ticker", "::FailsHalfWay"))
    runner = start("-m", EXECUTABLES, "standalone", str(graph), f"container:={ros.namespace}/box")
    log = runner.communicate(timeout=TIMEOUT_S)[0]
    assert runner.returncode == 1
    assert "error: ticker (sample_components::FailsHalfWay): ValueError: no gel on this se" in log
    assert "Traceback" not in log
    assert _loaded(ros) == []
    assert _end(container, signal.SIGTERM)[0] == 0


@pytest.mark.ros
def test_a_container_that_ends_ends_the_runner(ros, start, container, graph):
    runner = start("-m", EXECUTABLES, "standalone", str(graph), f"container:={ros.namespace}/box")
    assert runner.stdout is not None
    assert any("2 components run" in line for line in runner.stdout)
    assert _end(container, signal.SIGTERM)[0] == 0
    log = runner.stdout.read()
    runner.wait(TIMEOUT_S)
    assert (runner.returncode, "error: " in log, "the container has ended" in log) == (
        1,
        True,
        True,
    )


@pytest.mark.ros
def test_a_container_that_is_not_there_is_named(ros):
    client = ContainerClient(ros.node, "nobody/box", lambda: False)
    with pytest.raises(ComponentLoadError, match=r"/nobody/box: found no .* within 0\.2 s"):
        client.find(0.2)
    client.close()
    stopped = ContainerClient(ros.node, "nobody/box", lambda: True)
    with pytest.raises(StoppedError):
        stopped.find()
    stopped.close()


@pytest.fixture
def finger(ros) -> Iterator[tuple[str, Callable[[], None]]]:
    """Full name of a node, as of another process, and what lets it report once."""
    name = f"{ros.namespace}/ticker"
    node = rclpy.create_node("ticker", context=ros.context, namespace=ros.namespace)
    publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
    there = [KeyValue(key="process", value="1 on elsewhere")]
    status = DiagnosticStatus(name=name.lstrip("/"), values=there)
    yield name, lambda: publisher.publish(DiagnosticArray(status=[status]))
    node.destroy_node()


@pytest.mark.ros
def test_only_a_name_that_reports_is_in_use(ros, finger, monkeypatch):
    monkeypatch.setattr(graph_watch, "LISTEN_S", 0.3)
    names, (name, _) = NamesInUse(ros.node, discovery_s=0.0), finger
    assert names.process_of(f"{ros.namespace}/thumb", lambda: False) == ""
    ros.wait(lambda: times_named(ros.node, name), "the other node in the graph")
    # It reports nothing, as one that was killed; nor is anybody waited for where all is to end.
    assert names.process_of(name, lambda: True) == ""
    assert names.process_of(name, lambda: False) == ""


@pytest.mark.ros
def test_a_container_refuses_a_name_that_another_process_uses(ros, start, container, graph, finger):
    """Whoever asks for it: launch, `ros2 component load`, or `standalone` with container:=."""
    name, report = finger
    # Discovery may take longer than a container waits for it: only an answer shows that it is over.
    assert _loaded(ros) == []
    runner = start("-m", EXECUTABLES, "standalone", str(graph), f"container:={ros.namespace}/box")
    ros.wait(lambda: report() or runner.poll() is not None, "the refusal", TIMEOUT_S)
    assert runner.stdout is not None
    log = runner.stdout.read()
    assert runner.returncode == 1, log
    line = f"error: ticker (sample_components::Ticker): {name} runs already, in process 1 on else"
    assert line in log
    # What was loaded before is gone, too.
    assert _loaded(ros) == []


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
# Not marked `ros`: where ROS 2 is required, launch is not.
with_launch = pytest.mark.skipif(
    importlib.util.find_spec("launch_ros") is None, reason="launch_ros is not installed"
)


@with_launch
def test_launch_starts_a_container_and_ends_with_zero(ros, start, graph):
    answers = ros.listen(String, "answer")
    runner = start("-c", LAUNCH, str(graph), "prefix:=yes ")
    publisher = ros.publisher(String, "question")
    publisher.publish(String(data="there?"))
    ros.wait(lambda: answers, "the answer", TIMEOUT_S)
    assert answers[0].data == "yes there?"
    # Launch does not bear an end while it waits for an answer.
    _wait_for_line(runner, f"Loaded node '{ros.namespace}/ticker'")
    assert _loaded(ros, "not_this_one") == ["/echo", "/ticker"]
    # SIGTERM ends launch itself at once and leaves its processes behind.
    code, log = _end(runner, signal.SIGINT)
    assert (code, "Traceback" in log) == (0, False), log
    assert "process has finished cleanly" in log


@with_launch
def test_launch_loads_into_a_container_that_is_there(ros, start, container, graph):
    ticks = ros.listen(String, "ticks")
    runner = start("-c", LAUNCH, str(graph), f"container:={ros.namespace}/box")
    ros.wait(lambda: ticks, "ticks", TIMEOUT_S)
    _wait_for_line(runner, f"Loaded node '{ros.namespace}/ticker'")
    assert _end(runner, signal.SIGINT)[0] == 0
    # As with every launch file, they stay.
    assert _loaded(ros) == ["/echo", "/ticker"]
    assert _end(container, signal.SIGTERM)[0] == 0
