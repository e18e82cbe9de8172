"""A graph as actions of launch: arguments, container, components, RViz.

Needs launch and launch_ros; nothing else of the package imports this module.
"""

from __future__ import annotations

from collections.abc import Mapping

from launch import Action, LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.logging import get_logger
from launch_ros.actions import ComposableNodeContainer, LoadComposableNodes, Node
from launch_ros.descriptions import ComposableNode

from cmp_tactile_bringup.graphs import start
from cmp_tactile_bringup.graphs.description import RVIZ, Graph, GraphFunction, Value
from cmp_tactile_bringup.graphs.packaged import find_graph


def launch_description(name_or_path: str) -> LaunchDescription:
    """What the launch file of a graph describes: a packaged one, or that of a Python file."""
    graph = find_graph(name_or_path)
    declarations = [
        DeclareLaunchArgument(
            argument.name,
            description=argument.help,
            default_value=argument.default_text,
            choices=list(argument.allowed) or None,
        )
        for argument in (*graph.arguments, RVIZ)
    ]
    actions = OpaqueFunction(function=graph_actions, args=[graph])
    return LaunchDescription([*declarations, actions])


def graph_actions(context: LaunchContext, function: GraphFunction) -> list[Action]:
    """A container for each sensor of the graph with the arguments of this launch."""
    given = context.launch_configurations
    found = function.load({item.name: given[item.name] for item in function.arguments})
    graph = start.with_recordings(found, _Progress())
    start.check_recordings(graph)
    actions: list[Action] = [_running(part) for part in graph.by_sensor()]
    if graph.viewer is not None:
        actions.append(_web_viewer(graph.viewer))
    if given[RVIZ.name] == "true":
        actions.append(_rviz(graph))
    return actions


def _running(graph: Graph) -> Action:
    """The components in a container of their own, or in the one that they join."""
    nodes = composable_nodes(graph)
    if graph.joined:
        return LoadComposableNodes(
            composable_node_descriptions=nodes, target_container=graph.joined
        )
    return ComposableNodeContainer(
        package=start.PACKAGE,
        executable="component_container",
        name=graph.container,
        namespace=graph.namespace,
        composable_node_descriptions=nodes,
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


class _Progress:
    """Logs each thing that is done while a recording is made, once."""

    def __init__(self) -> None:
        self._last = ""

    def __call__(self, what: str, _share: float) -> None:
        if what != self._last:
            self._last = what
            get_logger(start.PACKAGE).info(what)


def _web_viewer(parameters: Mapping[str, Value]) -> Node:
    """A process of its own, which takes nothing from the sensors' interpreters."""
    return Node(
        package=start.VIEWER_PACKAGE,
        executable="web_viewer",
        parameters=[dict(parameters)],
        output="both",
    )


def _rviz(graph: Graph) -> Node:
    settings = start.rviz_settings_file(graph)
    if start.is_saved_by_rviz(settings):
        get_logger(start.PACKAGE).info(f"RViz opens as saved: delete {settings} to undo that")
    # Markers would vanish by the clock of the machine while a replay is paused.
    replayed = all(item.parameters.get("use_sim_time", False) for item in graph.components)
    return Node(
        package="rviz2",
        executable="rviz2",
        namespace=graph.namespace,
        arguments=["-d", str(settings)],
        parameters=[{"use_sim_time": replayed}],
    )
