"""What a user may set of every graph, beside the arguments that its file declares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from cmp_tactile_bringup.graphs.arguments import Argument, Value, argument_values
from cmp_tactile_bringup.graphs.description import Graph, load_graph, read_arguments
from cmp_tactile_bringup.graphs.parameter_file import parameters_of_nodes

__all__ = ["RUN_ARGUMENTS", "RVIZ", "GraphRun", "all_arguments", "read_run"]

RUN_ARGUMENTS = (
    Argument(
        "params_file",
        "path",
        "ROS parameter file; its values take precedence; empty for none",
        default="",
    ),
    Argument(
        "container",
        "text",
        "full name of a running container to load into; empty to start one",
        default="",
    ),
)
# Of the launch files alone.
RVIZ = Argument("rviz", "boolean", "show the sensors in RViz", default=False)


@dataclass(frozen=True)
class GraphRun:
    """A graph to start.  container: full name of a running one to load into; empty to start one.

    watch: write what the first sensor feels while it runs.
    """

    graph: Graph
    container: str
    watch: bool = False


def all_arguments(path: Path) -> tuple[Argument, ...]:
    """The arguments of a graph file, and those of every graph.

    Raises DescriptionError naming file, key, found and expected.
    """
    return (*read_arguments(path), *RUN_ARGUMENTS)


def read_run(path: Path, given: Mapping[str, Value | str]) -> GraphRun:
    """The graph of a file with these arguments, and where it is to run.

    Raises DescriptionError for the file, GraphError for arguments and parameter file.
    """
    argument_values(path, all_arguments(path), given)
    own = {argument.name for argument in RUN_ARGUMENTS}
    values = argument_values(
        path, RUN_ARGUMENTS, {name: value for name, value in given.items() if name in own}
    )
    graph = load_graph(path, {name: value for name, value in given.items() if name not in own})
    if values["params_file"]:
        names = [component.full_name for component in graph.components]
        file = Path(str(values["params_file"]))
        graph = graph.with_parameters(parameters_of_nodes(file, names))
    return GraphRun(graph, str(values["container"]))
