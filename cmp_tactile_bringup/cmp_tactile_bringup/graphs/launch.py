"""A graph as actions of launch: arguments, container, components, page, RViz.

Needs launch and launch_ros; nothing else of the package imports this module.
"""

from __future__ import annotations

from functools import cache

from launch import Action, LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.logging import get_logger
from launch_ros.actions import ComposableNodeContainer, LoadComposableNodes, Node
from launch_ros.descriptions import ComposableNode

from cmp_tactile_bringup.graphs.description import (
    CONTAINER,
    LAUNCH_ARGUMENTS,
    Graph,
    GraphFunction,
    check_recordings,
    with_recordings,
)
from cmp_tactile_bringup.graphs.packaged import find_graph
from cmp_tactile_bringup.graphs.rviz import PACKAGE, is_saved_by_rviz, rviz_settings_file


def launch_description(name_or_path: str) -> LaunchDescription:
    """What the launch file of a graph describes: a packaged one, or that of a Python file."""
    graph = find_graph(name_or_path)
    declarations = [
        DeclareLaunchArgument(
            argument.name,
            description=argument.description,
            default_value=argument.default_text,
            choices=list(argument.allowed) or None,
        )
        for argument in (*graph.arguments, *LAUNCH_ARGUMENTS)
    ]
    actions = OpaqueFunction(function=graph_actions, args=[graph])
    return LaunchDescription([*declarations, actions])


def graph_actions(context: LaunchContext, function: GraphFunction) -> list[Action]:
    """A container for each sensor, or the one to join, with the arguments of this launch."""
    given = context.launch_configurations
    found = function.load({item.name: given[item.name] for item in function.arguments})
    graph = with_recordings(found, lambda what, _share: _log_once(what))
    check_recordings(graph)
    actions: list[Action] = [_container(part) for part in graph.by_process()]
    if given["container"]:
        nodes = composable_nodes(graph)
        actions = [
            LoadComposableNodes(
                composable_node_descriptions=nodes, target_container=given["container"]
            )
        ]
    if graph.viewer is not None:
        # A process of its own, which takes nothing from the sensors' interpreters.
        viewer = Node(
            package="cmp_tactile_viewer",
            executable="web_viewer",
            parameters=[dict(graph.viewer)],
            output="both",
        )
        actions.append(viewer)
    if given["rviz"] == "true":
        actions.append(_rviz(graph))
    return actions


@cache
def _log_once(what: str) -> None:
    get_logger(PACKAGE).info(what)


def _container(graph: Graph) -> Action:
    return ComposableNodeContainer(
        package=PACKAGE,
        executable="component_container",
        name=CONTAINER,
        namespace=graph.namespace,
        composable_node_descriptions=composable_nodes(graph),
        output="both",
    )


def composable_nodes(graph: Graph) -> list[ComposableNode]:
    """The components of a graph as launch describes them, in their order."""
    return [
        ComposableNode(
            package=component.package,
            plugin=component.plugin,
            name=component.name,
            namespace=component.namespace,
            remappings=list(component.remappings.items()),
            parameters=[dict(component.parameters)],
            extra_arguments=[{"use_intra_process_comms": component.intra_process}],
        )
        for component in graph.components
    ]


def _rviz(graph: Graph) -> Node:
    settings = rviz_settings_file(graph)
    if is_saved_by_rviz(settings):
        get_logger(PACKAGE).info(
            f"RViz opens with its saved settings: delete {settings} for the packaged ones"
        )
    # Markers would vanish by the clock of the machine while a replay is paused, or a grasp slow.
    of_sensors = [item for item in graph.components if item.sensor]
    simulated = bool(of_sensors) and all(
        item.parameters.get("use_sim_time", False) for item in of_sensors
    )
    return Node(
        package="rviz2",
        executable="rviz2",
        namespace=graph.namespace,
        arguments=["-d", str(settings)],
        parameters=[{"use_sim_time": simulated}],
    )
