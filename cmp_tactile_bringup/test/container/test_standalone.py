"""The runner `standalone`, and what the graph files say of each component's parameters."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import yaml

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

import rclpy
from rclpy.lifecycle import LifecycleNode
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool

from cmp_tactile_bringup.container.component_description import ComponentDescription
from cmp_tactile_bringup.container.component_registry import find_component
from cmp_tactile_bringup.container.standalone import main
from cmp_tactile_bringup.graphs.description import Component, load_graph
from cmp_tactile_driver.sources.parameters import (
    CameraParameters,
    RecorderParameters,
    ReplayParameters,
)
from cmp_tactile_msgs.msg import Surface
from cmp_tactile_processing.sensor.parameters import (
    ForceParameters,
    SlipParameters,
    TrackingParameters,
    TriangulationParameters,
)
from cmp_tactile_processing.surface.drift import DriftParameters
from cmp_tactile_processing.surface.reference_keeping import ZeroParameters
from cmp_tactile_processing.surface.stillness import RestParameters
from cmp_tactile_simulation.live.motion import LiveSettings

CONFIG = Path(__file__).parents[2] / "config"
PROCESSING = CONFIG / "parts" / "processing.yaml"
# The first start of a version compiles the trackers.
TIMEOUT_S = 300.0
# A sensor without the force model, which takes its time.
GRAPH = """
version: 1
arguments:
  input: {type: recording, default: grasp, description: recording}
  rate: {type: number, default: 1.0, description: speed}
sensor_description: sample_rig
namespace: NAMESPACE
container: box
components:
  - {package: cmp_tactile_processing, plugin: "cmp_tactile_processing::ViewSplitter",
     name: view_splitter, parameters: {sensor_description: sample_rig}}
  - {package: cmp_tactile_processing, plugin: "cmp_tactile_processing::GridlineTracker",
     name: left, parameters: {sensor_description: sample_rig, view: left}}
  - {package: cmp_tactile_processing, plugin: "cmp_tactile_processing::GridlineTracker",
     name: right, parameters: {sensor_description: sample_rig, view: right}}
  - {package: cmp_tactile_processing, plugin: "cmp_tactile_processing::StereoTriangulator",
     name: stereo, parameters: {sensor_description: sample_rig}}
  - {package: cmp_tactile_driver, plugin: "cmp_tactile_driver::Replay", name: replay,
     parameters: {input: $(input), rate: $(rate), start: 0.2, wait_for_subscribers: 1}}
"""


def _standalone(*arguments: str, **options: Any) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "cmp_tactile_bringup.container.standalone", *arguments]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **options)


def _run(*arguments: str) -> tuple[int, str]:
    with _standalone(*arguments) as process:
        log = process.communicate(timeout=TIMEOUT_S)[1]
    return process.returncode, log


def test_a_process_that_cannot_start_says_why_and_ends_with_one():
    code, log = _run("none.yaml")
    assert code == 1
    assert log.startswith(
        "error: none.yaml: found no such file, expected a path or one of gripper, "
    )
    assert len(log.strip().splitlines()) == 1


@pytest.fixture
def own_signals() -> Iterator[None]:
    """The handlers of the tests come back after a runner in this process."""
    kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("own_signals")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["replay", "rate"], "error: found 'rate', expected NAME:=VALUE"),
        (["replay", "pace:=2"], "error: found argument 'pace', expected one of: frame_rate, sens"),
        (["replay", "loops:=true"], "; did you mean 'loop'?"),
        (["replay", "--set", "replay.loop=true", "pace:=2"], "found argument 'pace', expected one"),
        (["replay", "sensor:=nobody"], "sensor_description: nobody: found no such file"),
        (["replay", "--set", "drum.loop=true"], "found component 'drum', expected one of surface"),
    ],
)
def test_what_cannot_start_says_why_in_one_line(arguments, message, capfd):
    assert main(arguments) == 1
    log = capfd.readouterr().err
    assert message in log
    assert len(log.strip().splitlines()) == 1


@pytest.fixture
def graph_file(tmp_path: Path) -> tuple[Path, str]:
    path = tmp_path / "graph.yaml"
    namespace = f"/standalone_test_{os.getpid()}"
    path.write_text(GRAPH.replace("NAMESPACE", namespace))
    return path, namespace


def test_recording_that_is_not_there_is_told_before_anything_is_loaded(graph_file):
    code, log = _run(str(graph_file[0]), "input:=/nowhere")
    assert code == 1
    assert len(log.strip().splitlines()) == 1
    assert "error: replay (cmp_tactile_driver::Replay): /nowhere: found no such file" in log
    assert "Traceback" not in log


def test_component_that_cannot_be_loaded_ends_the_runner(graph_file, grasp_bag):
    code, log = _run(str(graph_file[0]), f"input:={grasp_bag}", "--set", "left.view=top")
    assert code == 1
    assert "error: left (cmp_tactile_processing::GridlineTracker):" in log
    assert "Traceback" not in log


def test_recording_that_fails_while_it_plays_ends_the_runner_with_one(graph_file, tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "0.png").write_bytes(b"no image")
    code, log = _run(str(graph_file[0]), f"input:={tmp_path / 'images'}")
    assert code == 1
    assert re.search(r"^error: replay: .*0\.png", log, re.MULTILINE)
    assert re.search(r"\[ERROR\].*failed: ", log)
    assert "Traceback" not in log


def test_the_chain_runs_and_ends_with_zero(graph_file, grasp_bag):
    path, namespace = graph_file
    context = rclpy.Context()
    context.init(args=[])
    node = rclpy.create_node("tester", context=context)
    executor = rclpy.executors.SingleThreadedExecutor(context=context)
    executor.add_node(node)
    stamps: list[int] = []
    node.create_subscription(
        Surface, f"{namespace}/surface", lambda m: stamps.append(m.header.stamp.nanosec), 50
    )
    setting = ["--set", "replay.rate=0.5", "--set", "replay.paused=true"]
    with _standalone(str(path), f"input:={grasp_bag}", *setting) as process:
        try:
            _resume(node, executor, namespace)
            _wait(executor, lambda: len(stamps) == 14, "14 surfaces")
            process.send_signal(signal.SIGTERM)
            log = process.communicate(timeout=TIMEOUT_S)[1]
        finally:
            process.kill()
    executor.shutdown()
    node.destroy_node()
    context.try_shutdown()
    assert process.returncode == 0, log
    assert "Traceback" not in log
    # From 0.2 s on at 30 Hz: frames 6 to 19.
    assert stamps == [round(k * 1e9 / 30) % 10**9 for k in range(6, 20)]


def _resume(node: Any, executor: Any, namespace: str) -> None:
    client = node.create_client(SetBool, f"{namespace}/replay/pause")
    _wait(executor, client.service_is_ready, "the service pause")
    future = client.call_async(SetBool.Request(data=False))
    _wait(executor, future.done, "the answer")


def _wait(executor: Any, condition: Any, what: str) -> None:
    end = time.monotonic() + TIMEOUT_S
    while not condition():
        if time.monotonic() > end:
            pytest.fail(f"waited {TIMEOUT_S:g} s in vain for {what}")
        executor.spin_once(timeout_sec=0.02)


def _declared(component: Component) -> dict[str, Any]:
    """Parameters of a component that is built without the graph's values."""
    context = rclpy.Context()
    context.init(args=[])
    needed = {"source": "", "input": "", "autostart": False}
    needed = {key: component.parameters[key] for key in needed if key in component.parameters}
    if "autostart" in needed:
        needed["autostart"] = False
    description = ComponentDescription(
        component.package,
        component.plugin,
        parameters=tuple(Parameter(key, value=value) for key, value in needed.items()),
    )
    node = find_component(component.package, component.plugin)(
        context=context, **description.node_arguments()
    )
    if isinstance(node, LifecycleNode):
        # A source declares its own parameters when it is opened.
        node.trigger_configure()
    found = {name: parameter.value for name, parameter in node.get_parameters_by_prefix("").items()}
    node.destroy_node()
    context.try_shutdown()
    # Thresholds of the diagnostics are listed once, for all.
    internal = ("qos_overrides.", "use_sim_time", "start_type_description_service", "diagnostics.")
    return {name: value for name, value in found.items() if not name.startswith(internal)}


# What every node has.
OF_NODES = {"use_sim_time"}


# Of each part: a graph that has its components, and the parameters that are for other sources.
PARTS = {
    "processing": ("replay", ()),
    "replay": ("replay", ()),
    "recorder": ("replay", ()),
    "simulated": ("simulate", asdict(CameraParameters())),
    "camera": ("sensor", ("input", "loop")),
}


@pytest.mark.parametrize("part", PARTS)
def test_a_part_lists_every_parameter_of_every_component(part, tmp_path):
    sections = (CONFIG / "parts" / f"{part}.yaml").read_text().split("  - package: ")[1:]
    (tmp_path / "0.png").write_bytes(b"opened only when it is read")
    name, of_others = PARTS[part]
    given = {"input": str(tmp_path), "record": str(tmp_path / "bag")} if name == "replay" else {}
    graph = load_graph(CONFIG / f"{name}.yaml", {**given, "sensor": "sample_rig"})
    components = {component.name: component for component in graph.components}
    for section in sections:
        (name,) = re.findall(r"^    name: (\w+)$", section, re.MULTILINE)
        listed = re.findall(r"^      (?:# )?([\w.]+):(?: |$)", section, re.MULTILINE)
        declared = set(_declared(components[name])) - set(of_others)
        assert sorted(set(listed) - OF_NODES) == sorted(declared), name


def test_the_graph_shows_the_defaults_of_the_stages():
    """A default that changes in its dataclass must change in the file too."""
    stages = (ForceParameters(), TrackingParameters(), TriangulationParameters())
    defaults = {name: value for stage in stages for name, value in asdict(stage).items()}
    defaults |= {f"slip.{name}": value for name, value in asdict(SlipParameters()).items()}
    shown = re.findall(r"^      # ([\w.]+): ?(.*)$", PROCESSING.read_text(), re.MULTILINE)
    assert {name for name, _ in shown} == set(defaults)
    for name, value in shown:
        assert yaml.safe_load(value) == defaults[name], name


def test_the_graph_gives_the_triangulator_the_defaults_of_rest_and_drift():
    graph = load_graph(CONFIG / "replay.yaml", {"sensor": "sample_rig"})
    (triangulator,) = (item for item in graph.components if item.name == "stereo_triangulator")
    for group in (ZeroParameters(), RestParameters(), DriftParameters()):
        for name, value in asdict(group).items():
            assert triangulator.parameters[name] == value, name


def test_the_live_graph_has_the_defaults_of_the_live_source():
    camera = load_graph(CONFIG / "simulate.yaml").components[-1]
    for name, value in asdict(LiveSettings()).items():
        assert camera.parameters[name] == value, name


def test_the_parts_have_the_defaults_of_camera_recorder_and_replay(tmp_path):
    given = {"sensor": "sample_rig", "record": str(tmp_path / "bag")}
    *_, recorder, camera = load_graph(CONFIG / "sensor.yaml", given).components
    replay = load_graph(CONFIG / "replay.yaml").components[-1]
    own = {"sensor_description", "output", "input", "wait_for_subscribers"}
    for component, defaults in (
        (recorder, RecorderParameters()),
        (camera, CameraParameters()),
        (replay, ReplayParameters()),
    ):
        for name, value in asdict(defaults).items():
            assert name in own or component.parameters[name] == value, (component.name, name)
