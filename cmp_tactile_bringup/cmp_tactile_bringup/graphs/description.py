"""Graphs: which components make up one sensor or several, with which names and parameters.

A graph is one Python function that returns a list of components; `graph` decorates it with what a
user may set when it is started.  Launch files and `standalone` both load it, packaged ones by name
and others by the path of their file.
"""

from __future__ import annotations

import os
import runpy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.errors import GraphError
from cmp_tactile_bringup.graphs.arguments import (
    RUN_ARGUMENTS,
    Argument,
    Value,
    argument_values,
    parameters_of_nodes,
)

__all__ = ["Argument", "Component", "Graph", "GraphFunction", "GraphSensor", "graph"]

CONTAINER = "tactile_container"
"""Name of the container that is started for a sensor."""


@dataclass(frozen=True)
class GraphSensor:
    """A sensor of a graph.  name: with which its tf frames begin.  namespace: absolute."""

    name: str
    namespace: str
    description: Path
    views: tuple[str, ...]


@dataclass(frozen=True)
class Component:
    """A component to load, with the fields of composition_interfaces/LoadNode.

    package, plugin: as in the entry point `package::Class`.  name, namespace: empty for the
    component's own.  remappings: from old to new name.  parameters: values by name, or rclpy's
    parameters.  log_level: a constant of rcl_interfaces/Log, 0 for the default.  intra_process:
    whether messages pass to other components of the process as objects.  sensor: its own.
    """

    package: str
    plugin: str
    name: str = ""
    namespace: str = ""
    remappings: Mapping[str, str] = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)
    log_level: int = 0
    intra_process: bool = True
    sensor: GraphSensor | None = None

    @property
    def full_name(self) -> str:
        """Namespace and name; empty for the component's own name."""
        return f"{absolute_name(self.namespace).rstrip('/')}/{self.name}" if self.name else ""

    @property
    def label(self) -> str:
        """What stands before errors of the component."""
        return f"{self.name or 'unnamed'} ({self.plugin})"


@dataclass(frozen=True)
class Graph:
    """Components in the order in which they are loaded.

    viewer: parameters of the page in the browser, None for no page.
    """

    components: tuple[Component, ...]
    viewer: Mapping[str, Value] | None = None

    @property
    def sensors(self) -> tuple[GraphSensor, ...]:
        """Those of the components, in their order."""
        found = (item.sensor for item in self.components if item.sensor is not None)
        return tuple(dict.fromkeys(found))

    @property
    def namespace(self) -> str:
        """That of the first component, where its container is, too."""
        return absolute_name(self.components[0].namespace)

    def by_sensor(self) -> tuple[Graph, ...]:
        """A graph for the container of each sensor: Python runs on one core in a process.

        One, where a component has no sensor.
        """
        if any(item.sensor is None for item in self.components):
            return (self,)
        return tuple(
            replace(self, components=tuple(c for c in self.components if c.sensor is sensor))
            for sensor in self.sensors
        )

    def with_parameters(self, parameters: Mapping[str, Mapping[str, Value]]) -> Graph:
        """The graph with parameters set by the full name of their component."""
        changed = tuple(
            replace(item, parameters={**item.parameters, **parameters.get(item.full_name, {})})
            for item in self.components
        )
        return replace(self, components=changed)


@dataclass(frozen=True)
class GraphFunction:
    """A graph with its arguments: what `graph` makes of a function.

    own_arguments: beside RUN_ARGUMENTS.  label: stands before errors.
    """

    function: Callable[[Mapping[str, Any]], Sequence[Component]]
    own_arguments: tuple[Argument, ...]
    label: str = ""

    @property
    def arguments(self) -> tuple[Argument, ...]:
        """All that a user may set."""
        return (*self.own_arguments, *RUN_ARGUMENTS)

    @property
    def summary(self) -> str:
        """The first line of the function's description."""
        return (self.function.__doc__ or "").strip().partition("\n")[0]

    def load(self, given: Mapping[str, Value] | None = None) -> Graph:
        """The graph with these arguments.

        given: values by name; texts, as a command line gives them, are converted to the argument's
        type.  Raises GraphError for arguments, names and parameter file that cannot be used.
        """
        values = argument_values(self.arguments, given or {}, self.label)
        own = {item.name: values[item.name] for item in self.own_arguments}
        found = Graph(tuple(self.function(own)))
        names = [component.full_name for component in found.components]
        twice = [name for number, name in enumerate(names) if name in names[:number]]
        if twice or not names:
            wrong = f"{twice[0]!r} twice" if twice else "no component"
            msg = f"{self.label}found {wrong}, expected components with different names"
            raise GraphError(msg)
        if values["params_file"]:
            file = Path(values["params_file"]).expanduser()
            found = found.with_parameters(parameters_of_nodes(file, names))
        return replace(found, viewer=_viewer(found, values)) if values["view"] else found


def _viewer(found: Graph, values: Mapping[str, Any]) -> dict[str, Value]:
    """Parameters of the node web_viewer for the sensors of a graph, at their mounting poses."""
    mounts = {
        item.sensor: [*item.parameters["mount_position"], *item.parameters["mount_orientation"]]
        for item in found.components
        if "mount_position" in item.parameters
    }
    sensors = found.sensors
    poses = (mounts.get(sensor, [0.0] * 6) for sensor in sensors)
    return {
        "sensors": " ".join(sensor.namespace for sensor in sensors),
        "sensor_descriptions": os.pathsep.join(str(sensor.description) for sensor in sensors),
        "sensor_names": " ".join(sensor.name for sensor in sensors),
        "mounts": ", ".join(" ".join(f"{number:.9g}" for number in pose) for pose in poses),
        "host": values["view_host"],
        "port": values["view_port"],
        "token": values["view_token"],
        "allow_hosts": values["view_allow_host"],
    }


def graph(
    *arguments: Argument,
) -> Callable[[Callable[[Mapping[str, Any]], Sequence[Component]]], GraphFunction]:
    """Make a graph of a function that takes the values of its arguments by name.

    The function returns the components in the order in which they are loaded; its description
    begins with a line about the graph.
    """
    return lambda function: GraphFunction(function, arguments)


def load_graph_file(path: Path) -> GraphFunction:
    """The graph that a Python file defines.

    Raises GraphError for a file that cannot be run or does not define just one.
    """
    name = f"cmp_tactile_graph_{path.stem}"
    try:
        defined = runpy.run_path(str(path), run_name=name) if path.suffix == ".py" else {}
    except Exception as error:
        msg = f"{path}: cannot be run: {type(error).__name__}: {error}"
        raise GraphError(msg) from error
    graphs = (item for item in defined.values() if isinstance(item, GraphFunction))
    found = [item for item in graphs if item.function.__module__ == name]
    if len(found) != 1:
        expected = "one: a Python file with one function that `graph` decorates (docs/launch.md)"
        msg = f"{path}: found {len(found) or 'no'} graphs, expected {expected}"
        raise GraphError(msg)
    return replace(found[0], label=f"{path}: ")


def absolute_name(namespace: str, below: str = "") -> str:
    """The absolute name of a namespace; a relative one is below another."""
    absolute = namespace if namespace.startswith("/") else f"{below}/{namespace}"
    return f"/{absolute.strip('/')}"
