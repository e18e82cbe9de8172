"""launch/replay.launch.py asks for the same components as `standalone`; needs a ROS with launch."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
import yaml

from cmp_tactile_bringup.graph import load_graph, read_arguments

ROOT = Path(__file__).parent.parent
CONFIG = ROOT / "config" / "replay.yaml"
LAUNCH_FILE = ROOT / "launch" / "replay.launch.py"

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("launch_ros") is None, reason="launch_ros is not installed"
)


def _arguments():
    from launch import LaunchContext
    from launch.launch_description_sources import PythonLaunchDescriptionSource

    source = PythonLaunchDescriptionSource(str(LAUNCH_FILE))
    return source.get_launch_description(LaunchContext()).get_launch_arguments()


def test_every_argument_of_the_graph_is_declared():
    declared = {argument.name: argument for argument in _arguments()}
    expected = {argument.name: argument for argument in read_arguments(CONFIG)}
    assert set(declared) == {*expected, "rviz", "container"}
    for name, argument in expected.items():
        assert declared[name].description.startswith(argument.description)
        default = "".join(part.text for part in declared[name].default_value)
        assert yaml.safe_load(default or "''") == argument.default
    assert declared["loop"].choices == ["true", "false"]


def test_load_requests_are_those_of_the_graph():
    from launch import LaunchContext
    from launch_ros.actions.load_composable_nodes import get_composable_node_load_request
    from rclpy.parameter import Parameter

    from cmp_tactile_bringup.launch_graph import composable_nodes

    given = {"rate": "0.5", "loop": "true", "namespace": "left_finger"}
    graph = load_graph(CONFIG, given)
    context = LaunchContext()
    for node, component in zip(composable_nodes(graph), graph.components, strict=True):
        request = get_composable_node_load_request(node, context)
        assert request.package_name == component.package
        assert request.plugin_name == component.plugin
        assert request.node_name == component.name
        assert request.node_namespace == component.namespace == "/left_finger"
        found = {p.name: Parameter.from_parameter_msg(p).value for p in request.parameters}
        assert found == dict(component.parameters)
        assert {k: type(v) for k, v in found.items()} == {
            k: type(v) for k, v in component.parameters.items()
        }


@pytest.mark.parametrize(("rviz", "count"), [("false", 1), ("true", 2)])
def test_rviz_is_started_when_asked_for(rviz, count):
    from launch import LaunchContext

    from cmp_tactile_bringup.launch_graph import graph_actions

    context = LaunchContext()
    for argument in read_arguments(CONFIG):
        default = argument.default
        text = str(default).lower() if isinstance(default, bool) else str(default)
        context.launch_configurations[argument.name] = text
    context.launch_configurations.update({"rviz": rviz, "container": ""})
    assert len(graph_actions(context, CONFIG)) == count
