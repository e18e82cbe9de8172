"""The launch files ask for the same components as `standalone`; needs a ROS with launch."""

import importlib.util
from pathlib import Path

import pytest

from cmp_tactile_bringup.graphs import packaged
from cmp_tactile_bringup.graphs.description import LAUNCH_ARGUMENTS

ROOT = Path(__file__).parents[2]
# What is given to each, beside a mounting.
GRAPHS = {
    "replay": {"rate": "0.5", "loop": "true", "namespace": "hand", "name": "left_finger"},
    "simulate": {"autoplay": "false", "name": "left_finger", "container": "/box"},
    "sensor": {"sensor": "sample_rig", "device": "/dev/video7", "record": "nowhere/bag"},
    "gripper": {"left_source": "replay", "left_input": "grasp", "right_mount": "0 0 1 0 0 0"},
    "grasp": {"scene": "flask", "drive": "command"},
}

pytestmark = [
    pytest.mark.skipif(
        importlib.util.find_spec("launch_ros") is None, reason="launch_ros is not installed"
    ),
    pytest.mark.parametrize("name", GRAPHS),
]


def _launch_file(name):
    from launch import LaunchContext
    from launch.launch_description_sources import PythonLaunchDescriptionSource

    source = PythonLaunchDescriptionSource(str(ROOT / "launch" / f"{name}.launch.py"))
    return source.get_launch_description(LaunchContext())


def _text(substitutions):
    return None if substitutions is None else "".join(part.text for part in substitutions)


def test_every_argument_of_the_graph_is_declared(name):
    declared = {argument.name: argument for argument in _launch_file(name).get_launch_arguments()}
    expected = {
        argument.name: argument
        for argument in (*packaged.GRAPHS[name].arguments, *LAUNCH_ARGUMENTS)
    }
    assert list(declared) == list(expected)
    for key, argument in expected.items():
        assert declared[key].description.startswith(argument.description)
        assert _text(declared[key].default_value) == argument.default_text
        assert declared[key].choices == (list(argument.allowed) or None)


@pytest.fixture
def actions(name, short_scenes, grasp_bag):
    """The actions of the launch file, and their context, with more arguments than those above."""
    from launch import LaunchContext

    from cmp_tactile_bringup.graphs.launch import graph_actions

    def make(**more):
        context = LaunchContext()
        for argument in (*packaged.GRAPHS[name].arguments, *LAUNCH_ARGUMENTS):
            context.launch_configurations[argument.name] = argument.default_text
        context.launch_configurations.update({**GRAPHS[name], **more})
        return context, graph_actions(context, packaged.GRAPHS[name])

    return make


def test_load_requests_are_those_of_the_graph(name, actions, grasp_bag):
    from launch_ros.actions.load_composable_nodes import get_composable_node_load_request
    from rclpy.parameter import Parameter

    from cmp_tactile_bringup.graphs.description import with_recordings
    from cmp_tactile_bringup.graphs.launch import composable_nodes

    given = {key: value for key, value in GRAPHS[name].items() if key != "container"}
    graph = with_recordings(packaged.load_graph(name, given))
    context, _ = actions()
    for node, component in zip(composable_nodes(graph), graph.components, strict=True):
        request = get_composable_node_load_request(node, context)
        assert request.package_name == component.package
        assert request.plugin_name == component.plugin
        assert request.node_name == component.name
        assert request.node_namespace == component.namespace
        found = {p.name: Parameter.from_parameter_msg(p).value for p in request.parameters}
        found = {k: v if isinstance(v, str) else _plain(v) for k, v in found.items()}
        assert found == dict(component.parameters)
        assert {k: type(v) for k, v in found.items()} == {
            k: type(v) for k, v in component.parameters.items()
        }
        (extra,) = request.extra_arguments
        assert (extra.name, extra.value.bool_value) == ("use_intra_process_comms", True)


def _plain(value):
    return list(value) if hasattr(value, "__len__") else value


def test_a_container_is_started_or_joined(name, actions):
    from launch_ros.actions import ComposableNodeContainer, LoadComposableNodes

    _, started = actions(container="")
    _, joined = actions(container="/hand/box")
    containers = {"gripper": 2, "grasp": 3}.get(name, 1)
    assert [type(action) for action in started] == [ComposableNodeContainer] * containers
    assert [type(action) for action in joined] == [LoadComposableNodes]


def test_rviz_is_started_when_asked_for(name, actions, tmp_path, monkeypatch):
    from launch_ros.actions import Node
    from launch_ros.utilities import evaluate_parameters

    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    context, (*_, rviz) = actions(rviz="true")
    assert isinstance(rviz, Node)
    assert (rviz.node_package, rviz.node_executable) == ("rviz2", "rviz2")
    # Else the markers of a replay that is paused would vanish.
    (parameters,) = evaluate_parameters(context, rviz._Node__parameters)
    assert parameters == {"use_sim_time": name in ("replay", "grasp")}


def test_the_page_is_started_when_asked_for(name, actions):
    from launch_ros.actions import Node
    from launch_ros.utilities import evaluate_parameters

    word = "1234"
    context, (*_, viewer) = actions(
        view="true", view_port="8123", view_token=word, view_allow_host="a.example b.example"
    )
    assert isinstance(viewer, Node)
    assert (viewer.node_package, viewer.node_executable) == ("cmp_tactile_viewer", "web_viewer")
    (parameters,) = evaluate_parameters(context, viewer._Node__parameters)
    assert (parameters["host"], parameters["port"]) == ("127.0.0.1", 8123)
    # A text that looks like a number stays one.
    assert parameters["token"] == word
    assert parameters["allow_hosts"].split() == ["a.example", "b.example"]
    count = 2 if name in ("gripper", "grasp") else 1
    assert len(parameters["sensors"].split()) == count
    assert len(parameters["mounts"].split(",")) == count
