"""The runner `standalone`, and the parameters that the packaged graphs set."""

import os
import re
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

import rclpy
from rclpy.lifecycle import LifecycleNode
from sensor_msgs.msg import CameraInfo
from std_srvs.srv import SetBool
from waiting import wait_until

from cmp_tactile_bringup.container.components import find_component, node_arguments
from cmp_tactile_bringup.container.executables import standalone
from cmp_tactile_bringup.graphs.description import Component
from cmp_tactile_bringup.graphs.packaged import load_graph
from cmp_tactile_msgs.msg import Surface

EXECUTABLES = "cmp_tactile_bringup.container.executables"
# The first start of a version compiles the trackers.
TIMEOUT_S = 300.0
# A sensor without the force model, which takes its time.
GRAPH = '''
from cmp_tactile_bringup.graphs.description import graph
from cmp_tactile_bringup.graphs.one_sensor import sensor_arguments, sensor_components

@graph(*sensor_arguments(["replay"]))
def mine(given):
    """A recording into the first stages."""
    own = {"source": "replay", "sensor": "sample_rig", "namespace": "NAMESPACE", "start": 0.2}
    nodes, source = sensor_components({**given, **own})
    wanted = ("view_splitter", "stereo_triangulator")
    found = [item for item in nodes if item.name in wanted or item.name.endswith("tracker")]
    return [*found, *source]
'''


def _standalone(*arguments: str, **options: Any) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", EXECUTABLES, "standalone", *arguments]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **options)


def _run(*arguments: str) -> tuple[int, str]:
    with _standalone(*arguments) as process:
        log = process.communicate(timeout=TIMEOUT_S)[1]
    return process.returncode, log


@pytest.mark.usefixtures("own_signals")
@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["-r", "bad"], "Couldn't parse remap rule: '-r bad'"),
        (["-p", "rate"], "Couldn't parse parameter override rule: '-p rate'"),
        (["--log-level", "loud"], "Couldn't parse log level: '--log-level loud'"),
    ],
)
def test_wrong_ros_arguments_are_one_line(arguments, error, capfd):
    assert standalone(["sensor", "sensor:=sample_rig", "--ros-args", *arguments]) == 1
    log = capfd.readouterr().err
    assert log.splitlines()[-1].startswith("error: ")
    assert error in log.splitlines()[-1]
    assert "Traceback" not in log


@pytest.mark.usefixtures("own_signals")
@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["none.py"], 2, "error: none.py: found no such file, expected a path or one of grasp, "),
        (["replay", "rate"], 2, "error: found 'rate', expected NAME:=VALUE"),
        (["replay", "pace:=2"], 2, "error: found argument 'pace', expected one of: sensor, name, "),
        (["replay", "loop:=maybe"], 2, "error: argument loop: found 'maybe', expected a boolean"),
        (["replay", "sensor:=nobody"], 2, "error: argument sensor: nobody: found no such file"),
        (["simulate", "scene:=slpi"], 2, "did you mean 'slip'?"),
        (["simulate", "container:=/x"], 2, "error: found argument 'container', expected one of"),
    ],
)
def test_what_cannot_start_says_why_in_one_line(arguments, code, message, capfd):
    assert standalone(arguments) == code
    log = capfd.readouterr().err
    assert message in log
    assert len(log.strip().splitlines()) == 1


@pytest.fixture
def graph_file(tmp_path: Path) -> tuple[Path, str]:
    path = tmp_path / "graph.py"
    namespace = f"/standalone_test_{os.getpid()}"
    path.write_text(GRAPH.replace("NAMESPACE", namespace))
    return path, namespace


@pytest.mark.usefixtures("own_signals")
def test_a_recording_that_is_not_there_is_reported_before_anything_is_loaded(graph_file, capfd):
    assert standalone([str(graph_file[0]), "input:=/nowhere"]) == 1
    log = capfd.readouterr().err
    assert len(log.strip().splitlines()) == 1
    assert "error: replay (cmp_tactile_driver::Replay): /nowhere: found no such file" in log
    assert "Traceback" not in log


def test_component_that_cannot_be_loaded_ends_the_runner(graph_file, grasp_bag):
    params = graph_file[0].with_suffix(".yaml")
    params.write_text("/**/left_gridline_tracker: {ros__parameters: {view: top}}")
    code, log = _run(str(graph_file[0]), f"input:={grasp_bag}", f"params_file:={params}")
    assert code == 1
    assert "error: left_gridline_tracker (cmp_tactile_processing::GridlineTracker):" in log
    assert "Traceback" not in log


def test_recording_that_fails_while_it_plays_ends_the_runner_with_one(graph_file, tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "0.png").write_bytes(b"no image")
    code, log = _run(str(graph_file[0]), f"input:={tmp_path / 'images'}")
    assert code == 1
    assert re.search(r"^error: replay: .*0\.png", log, re.MULTILINE)
    assert re.search(r"\[ERROR\].*failed: ", log)
    assert "Traceback" not in log


def test_the_chain_runs_and_ends_with_zero(ros, graph_file, grasp_bag):
    path, namespace = graph_file
    surfaces = ros.listen(Surface, f"{namespace}/surface")
    request = SetBool.Request(data=False)
    setting = ["rate:=0.5", "paused:=true"]
    with _standalone(str(path), f"input:={grasp_bag}", *setting) as process:
        try:
            ros.call(SetBool, f"{namespace}/replay/pause", request, TIMEOUT_S)
            ros.wait(lambda: len(surfaces) == 14, "14 surfaces")
            code, said = _run(str(path), f"input:={grasp_bag}")
            assert code == 1
            assert f"error: {namespace}: found a sensor of this name that runs already" in said
            process.send_signal(signal.SIGTERM)
            log = process.communicate(timeout=TIMEOUT_S)[1]
        finally:
            process.kill()
    assert process.returncode == 0, log
    assert "Traceback" not in log
    # From 0.2 s on at 30 Hz: frames 6 to 19.
    stamps = [message.header.stamp.nanosec for message in surfaces]
    assert stamps == [round(k * 1e9 / 30) % 10**9 for k in range(6, 20)]


@pytest.mark.parametrize("way", [signal.SIGINT, signal.SIGKILL])
def test_the_page_begins_and_ends_with_the_runner(way, graph_file, grasp_bag):
    """At the address that is asked for, with the token; a process that ends with this one."""
    with socket.create_server(("127.0.0.1", 0)) as trial:
        port = trial.getsockname()[1]
    address = f"http://127.0.0.1:{port}/?token=a%20word"
    view = ["view:=true", f"view_port:={port}", "view_token:=a word"]
    arguments = [f"input:={grasp_bag}", "paused:=true", *view]

    def status(url: str) -> int:
        try:
            with urllib.request.urlopen(url, timeout=5.0) as answer:  # noqa: S310
                return int(answer.status)
        except urllib.error.HTTPError as error:
            return error.code
        except OSError:
            return 0

    with _standalone(str(graph_file[0]), *arguments) as process:
        try:
            assert process.stderr is not None
            said = next((line for line in process.stderr if "in a browser" in line), "")
            assert f"open {address} in a browser" in said
            assert status(address) == 200
            assert status(f"http://127.0.0.1:{port}/") == 403
            process.send_signal(way)
            log = process.communicate(timeout=TIMEOUT_S)[1]
        finally:
            process.kill()
    assert process.returncode == (0 if way is signal.SIGINT else -way), log
    assert "Traceback" not in log
    wait_until(lambda: status(address) == 0, "the end of the page")


FINGERS = """
from cmp_tactile_bringup.graphs.description import Argument
from cmp_tactile_bringup.graphs.description import graph
from cmp_tactile_bringup.graphs.one_sensor import sensor_components

@graph(Argument("input", "recording", "grasp"))
def fingers(given):
    'A recording into the splitters of two sensors.'
    found = []
    for name in ("left_finger", "right_finger"):
        nodes, source = sensor_components(
            given, source="replay", sensor="sample_rig", name=name, namespace=f"NAMESPACE/{name}",
            publish_clock=False, loop=True,
        )
        found += [item for item in nodes if item.name == "view_splitter"] + source
    return found
"""


@pytest.mark.parametrize("way", ["signal", "killed", "other killed"])
def test_each_sensor_has_a_process_and_all_end_together(way, ros, tmp_path, grasp_bag):
    namespace = f"/hand_{os.getpid()}_{way.replace(' ', '_')}"
    path = tmp_path / "fingers.py"
    path.write_text(FINGERS.replace("NAMESPACE", namespace))
    seen = [
        ros.listen(CameraInfo, f"{namespace}/{name}/left/camera_info")
        for name in ("left_finger", "right_finger")
    ]
    with _standalone(str(path), f"input:={grasp_bag}") as process:
        try:
            ros.wait(lambda: all(seen), "frames of both", TIMEOUT_S)
            (other,) = _children(process.pid)
            if way == "signal":
                process.terminate()
            else:
                os.kill(other if way == "other killed" else process.pid, signal.SIGKILL)
            code = process.wait(TIMEOUT_S)
            ros.wait(lambda: not Path(f"/proc/{other}").exists(), "the end of the other")
            log = process.communicate(timeout=TIMEOUT_S)[1]
        finally:
            process.kill()
    assert code == {"signal": 0, "killed": -signal.SIGKILL, "other killed": 1}[way], log
    assert ("right_finger: its process ended with code -9" in log) is (way == "other killed")
    assert "Traceback" not in log


def _children(pid: int) -> list[int]:
    """Processes that another has started with Python."""
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(item) for item in text.split()]


def _declared(component: Component) -> set[str]:
    """Parameters of a component that is built with what it needs alone."""
    context = rclpy.Context()
    context.init(args=[])
    needed = {
        name: component.parameters[name]
        for name in ("source", "input")
        if name in component.parameters
    }
    if component.name in ("camera_driver", "recorder"):
        needed["autostart"] = False
    node = find_component(component.package, component.plugin)(
        context=context, **node_arguments(replace(component, parameters=needed))
    )
    if isinstance(node, LifecycleNode):
        # A source declares its own parameters when it is opened.
        node.trigger_configure()
    found = set(node.get_parameters_by_prefix(""))
    node.destroy_node()
    context.try_shutdown()
    return found


@pytest.mark.parametrize("name", ["simulate", "replay", "sensor"])
def test_the_packaged_graphs_set_parameters_that_their_nodes_have(name, tmp_path):
    (tmp_path / "0.png").write_bytes(b"opened only when it is read")
    given = {"input": str(tmp_path)} if name == "replay" else {}
    given |= {"sensor": "sample_rig", "record": str(tmp_path / "bag")}
    seen = ("surface_visualizer", "stereo_triangulator", "recorder") if name != "replay" else ()
    for component in load_graph(name, given).components:
        if component.name not in seen:
            assert set(component.parameters) <= _declared(component), component.name
