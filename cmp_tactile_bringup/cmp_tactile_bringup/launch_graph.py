"""A graph file as actions of launch: arguments, container, components, RViz.

Needs launch and launch_ros; nothing else of the package imports this module.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from launch import Action, LaunchContext
from launch.actions import DeclareLaunchArgument
from launch_ros.actions import ComposableNodeContainer, LoadComposableNodes, Node
from launch_ros.descriptions import ComposableNode

from cmp_tactile_bringup.graph import Component, Graph, load_graph, read_arguments
from cmp_tactile_bringup.graph_recordings import with_recordings
from cmp_tactile_bringup.shared_files import share_folder
from cmp_tactile_processing.sensor_library import load_sensor

__all__ = ["argument_actions", "composable_nodes", "graph_actions"]

_BOOLEAN = ["true", "false"]
PACKAGE = "cmp_tactile_bringup"
# The sensor whose namespace and frames rviz/cmp_tactile.rviz shows as it is.
RVIZ_SENSOR = "sample_rig"


def argument_actions(path: Path) -> list[Action]:
    """The arguments of the graph file, and those that every launch file has."""
    declared = [
        DeclareLaunchArgument(
            argument.name,
            description=argument.description,
            default_value=None if argument.default is None else _text(argument.default),
            choices=_choices(argument.type, argument.choices),
        )
        for argument in read_arguments(path)
    ]
    rviz = DeclareLaunchArgument(
        "rviz", description="show the sensor in RViz", default_value="false", choices=_BOOLEAN
    )
    container = DeclareLaunchArgument(
        "container",
        description="full name of a running container to load into; empty to start one",
        default_value="",
    )
    return [*declared, rviz, container]


def graph_actions(context: LaunchContext, path: Path) -> list[Action]:
    """Container and components of the graph file with the arguments of this launch."""
    names = [argument.name for argument in read_arguments(path)]
    given = context.launch_configurations
    graph = with_recordings(load_graph(path, {name: given[name] for name in names}))
    nodes = composable_nodes(graph)
    target = given["container"]
    if target:
        loading = LoadComposableNodes(composable_node_descriptions=nodes, target_container=target)
    else:
        loading = ComposableNodeContainer(
            package=PACKAGE,
            executable="component_container",
            name=graph.container,
            namespace=graph.namespace,
            composable_node_descriptions=nodes,
            output="both",
        )
    return [loading, _rviz(graph)] if given["rviz"] == "true" else [loading]


def composable_nodes(graph: Graph) -> list[ComposableNode]:
    """The components of a graph as launch describes them, in their order."""
    return [_composable(component) for component in graph.components]


def _choices(kind: str, choices: tuple[str, ...]) -> list[str] | None:
    return list(choices) or (_BOOLEAN if kind == "boolean" else None)


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _composable(component: Component) -> ComposableNode:
    return ComposableNode(
        package=component.package,
        plugin=component.plugin,
        name=component.name,
        namespace=component.namespace,
        remappings=list(component.remappings.items()),
        parameters=[dict(component.parameters)],
    )


def _rviz(graph: Graph) -> Node:
    sensor = load_sensor(str(graph.sensor_description)).ros_name
    settings = (share_folder() / "rviz" / "cmp_tactile.rviz").read_text(encoding="utf-8")
    settings = settings.replace(f"{RVIZ_SENSOR}_gel_frame", f"{sensor}_gel_frame")
    with tempfile.NamedTemporaryFile(
        "w", prefix=f"{sensor}_", suffix=".rviz", delete=False, encoding="utf-8"
    ) as file:
        file.write(settings.replace(f"/{RVIZ_SENSOR}/", f"{graph.namespace}/"))
    return Node(
        package="rviz2",
        executable="rviz2",
        namespace=graph.namespace,
        arguments=["-d", file.name],
    )
