"""The launch files ask for the same components as `standalone`; needs a ROS with launch."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
import yaml

from cmp_tactile_bringup.graph import load_graph, read_arguments

ROOT = Path(__file__).parent.parent
GRAPHS = {"replay": {"rate": "0.5", "loop": "true"}, "live": {"max_speed": "0.5"}}

pytestmark = [
    pytest.mark.skipif(
        importlib.util.find_spec("launch_ros") is None, reason="launch_ros is not installed"
    ),
    pytest.mark.parametrize("name", GRAPHS),
]


def _config(name):
    return ROOT / "config" / f"{name}.yaml"


def _arguments(name):
    from launch import LaunchContext
    from launch.launch_description_sources import PythonLaunchDescriptionSource

    source = PythonLaunchDescriptionSource(str(ROOT / "launch" / f"{name}.launch.py"))
    return source.get_launch_description(LaunchContext()).get_launch_arguments()


def test_every_argument_of_the_graph_is_declared(name):
    declared = {argument.name: argument for argument in _arguments(name)}
    expected = {argument.name: argument for argument in read_arguments(_config(name))}
    assert set(declared) == {*expected, "rviz", "container"}
    for key, argument in expected.items():
        assert declared[key].description.startswith(argument.description)
        default = "".join(part.text for part in declared[key].default_value)
        assert yaml.safe_load(default or "''") == argument.default
    for key in ("loop", "autoplay"):
        assert key not in declared or declared[key].choices == ["true", "false"]


def test_load_requests_are_those_of_the_graph(name):
    from launch import LaunchContext
    from launch_ros.actions.load_composable_nodes import get_composable_node_load_request
    from rclpy.parameter import Parameter

    from cmp_tactile_bringup.launch_graph import composable_nodes

    graph = load_graph(_config(name), {**GRAPHS[name], "namespace": "left_finger"})
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
def test_rviz_is_started_when_asked_for(name, rviz, count, short_scenes, grasp_bag):
    from launch import LaunchContext

    from cmp_tactile_bringup.launch_graph import graph_actions

    context = LaunchContext()
    for argument in read_arguments(_config(name)):
        default = argument.default
        text = str(default).lower() if isinstance(default, bool) else str(default)
        context.launch_configurations[argument.name] = text
    context.launch_configurations.update({"rviz": rviz, "container": ""})
    assert len(graph_actions(context, _config(name))) == count
