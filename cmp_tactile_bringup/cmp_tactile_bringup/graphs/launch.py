"""A graph file as actions of launch: arguments, container, components, RViz.

Needs launch and launch_ros; nothing else of the package imports this module.
"""

from __future__ import annotations

from pathlib import Path

from launch import Action, LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.logging import get_logger
from launch_ros.actions import ComposableNodeContainer, LoadComposableNodes, Node
from launch_ros.descriptions import ComposableNode

from cmp_tactile_bringup.graphs.arguments import Argument
from cmp_tactile_bringup.graphs.description import Component, Graph
from cmp_tactile_bringup.graphs.recordings import check_recordings, with_recordings
from cmp_tactile_bringup.graphs.run_arguments import RVIZ, all_arguments, read_run
from cmp_tactile_bringup.graphs.rviz_settings import write_rviz_settings
from cmp_tactile_bringup.graphs.shared_files import find_config

__all__ = ["argument_actions", "composable_nodes", "graph_actions", "launch_description"]

PACKAGE = "cmp_tactile_bringup"


def launch_description(name: str) -> LaunchDescription:
    """What the launch file of a packaged graph describes."""
    path = find_config(name)
    return LaunchDescription(
        [*argument_actions(path), OpaqueFunction(function=graph_actions, args=[path])]
    )


def argument_actions(path: Path) -> list[Action]:
    """The arguments of the graph file, and those that every launch file has."""
    return [_declaration(argument) for argument in (*all_arguments(path), RVIZ)]


def graph_actions(context: LaunchContext, path: Path) -> list[Action]:
    """Container and components of the graph file with the arguments of this launch."""
    given = context.launch_configurations
    run = read_run(path, {argument.name: given[argument.name] for argument in all_arguments(path)})
    graph = with_recordings(run.graph, _Progress())
    check_recordings(graph)
    nodes = composable_nodes(graph)
    actions: list[Action] = []
    if run.container:
        actions.append(
            LoadComposableNodes(composable_node_descriptions=nodes, target_container=run.container)
        )
    else:
        actions.append(
            ComposableNodeContainer(
                package=PACKAGE,
                executable="component_container",
                name=graph.container,
                namespace=graph.namespace,
                composable_node_descriptions=nodes,
                output="both",
            )
        )
    if given[RVIZ.name] == "true":
        actions.append(_rviz(graph))
    return actions


def composable_nodes(graph: Graph) -> list[ComposableNode]:
    """The components of a graph as launch describes them, in their order."""
    return [_composable(component) for component in graph.components]


class _Progress:
    """Logs each thing that is done while a recording is made, once."""

    def __init__(self) -> None:
        self._last = ""

    def __call__(self, what: str, _share: float) -> None:
        if what != self._last:
            self._last = what
            get_logger(PACKAGE).info(what)


def _declaration(argument: Argument) -> DeclareLaunchArgument:
    return DeclareLaunchArgument(
        argument.name,
        description=argument.help,
        default_value=argument.default_text,
        choices=list(argument.allowed) or None,
    )


def _composable(component: Component) -> ComposableNode:
    return ComposableNode(
        package=component.package,
        plugin=component.plugin,
        name=component.name,
        namespace=component.namespace,
        remappings=list(component.remappings.items()),
        parameters=[dict(component.parameters)],
        extra_arguments=[{"use_intra_process_comms": True}],
    )


def _rviz(graph: Graph) -> Node:
    # Markers would vanish by the clock of the machine while a replay is paused.
    replayed = all(item.parameters.get("use_sim_time", False) for item in graph.components)
    return Node(
        package="rviz2",
        executable="rviz2",
        namespace=graph.namespace,
        arguments=["-d", str(write_rviz_settings(graph))],
        parameters=[{"use_sim_time": replayed}],
    )
