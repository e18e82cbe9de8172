"""Graphs: which components make up one sensor or several, with which names and parameters.

A graph is one Python function that returns a list of components; `graph` decorates it with what a
user may set when it is started.  Launch files and `standalone` both load it, packaged ones by name
and others by the path of their file.  `Argument` and `Condition` may be imported from here, too.
"""

from __future__ import annotations

import os
import re
import runpy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.errors import ComponentLoadError, GraphError
from cmp_tactile_bringup.graphs.arguments import (
    RUN_ARGUMENTS,
    Argument,
    Condition,
    Value,
    argument_values,
    check_use,
    parse_value,
)
from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.sensor.yaml_section import YamlSection, read_yaml

__all__ = ["Argument", "Component", "Condition", "Graph", "GraphFunction", "GraphSensor", "graph"]

# Two underscores in a row stand for themselves in ROS's remapping rules.
ROS_NAME = re.compile(r"(?!.*__)[A-Za-z_]\w*", re.ASCII)
ROS_NAMESPACE = re.compile(r"(?!.*__)(/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*|/?)", re.ASCII)
LETTERS = "letters, digits, single underscores"
# Constants of rcl_interfaces/Log; 0 for the default.
LOG_LEVELS = (0, 10, 20, 30, 40, 50)
PARAMETERS = "ros__parameters"


@dataclass(frozen=True)
class GraphSensor:
    """A sensor of a graph.

    own_name: with which its tf frames begin; empty for that of the description.  namespace:
    absolute.
    """

    own_name: str
    ros_name: str
    namespace: str
    description: Path
    views: tuple[str, ...]

    @property
    def name(self) -> str:
        """With which its tf frames begin."""
        return self.own_name or self.ros_name

    def component(self, plugin: str, name: str, parameters: Mapping[str, Value]) -> Component:
        """A component in the sensor's namespace that knows its description and name."""
        own = {"sensor_description": str(self.description), "sensor_name": self.own_name}
        package = plugin.partition("::")[0]
        return Component(
            package, plugin, name, self.namespace, parameters={**own, **parameters}, sensor=self
        )


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
        namespace = f"/{self.namespace.strip('/')}".rstrip("/")
        return f"{namespace}/{self.name}" if self.name else ""

    @property
    def label(self) -> str:
        """What stands before errors of the component."""
        return f"{self.name or 'unnamed'} ({self.plugin})"

    def check(self) -> None:
        """Raise ComponentLoadError for what ROS would refuse in its own terms."""
        if self.log_level not in LOG_LEVELS:
            msg = f"log level: found {self.log_level}, expected one of {LOG_LEVELS}"
        elif self.name and not ROS_NAME.fullmatch(self.name):
            msg = f"node name: found {self.name!r}, expected {LETTERS}"
        elif not ROS_NAMESPACE.fullmatch(self.namespace):
            msg = f"namespace: found {self.namespace!r}, expected names of {LETTERS}, joined by /"
        else:
            rules = (f"{old}:={new}" for old, new in self.remappings.items())
            wrong = [rule for rule in rules if not re.fullmatch(r"\S+:=\S+", rule)]
            if not wrong:
                return
            msg = f"remap rule: found {wrong[0]!r}, expected FROM:=TO without spaces"
        raise ComponentLoadError(f"{self.label}: {msg}")


@dataclass(frozen=True)
class Graph:
    """Components in the order in which they are loaded.

    container: name of the one that is started.  viewer: parameters of the page in the browser, None
    for no page.
    """

    components: tuple[Component, ...]
    container: str
    viewer: Mapping[str, Value] | None = None

    @property
    def sensors(self) -> tuple[GraphSensor, ...]:
        """Those of the components, in their order."""
        found = (item.sensor for item in self.components if item.sensor is not None)
        return tuple(dict.fromkeys(found))

    @property
    def namespace(self) -> str:
        """Of the only sensor; where there are several, what their components have in common."""
        if len(self.sensors) == 1:
            return self.sensors[0].namespace
        return os.path.commonpath([absolute_name(item.namespace) for item in self.components])

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

    def with_parameter(self, assignment: str) -> Graph:
        """The graph with `COMPONENT.PARAMETER=VALUE` set, VALUE in YAML.

        COMPONENT: a name, then for all components that have it, or the end of a full one.
        Raises GraphError for anything else and for a component that the graph lacks.
        """
        target, equals, text = assignment.partition("=")
        owner, dot, parameter = target.partition(".")
        if not (equals and dot and parameter):
            msg = f"found {assignment!r}, expected COMPONENT.PARAMETER=VALUE"
            raise GraphError(msg)
        ending = f"/{owner.lstrip('/')}"
        meant = [item for item in self.components if item.full_name.endswith(ending)]
        if not meant:
            names = ", ".join(dict.fromkeys(item.name for item in self.components))
            msg = f"{assignment}: found component {owner!r}, expected one of {names}"
            raise GraphError(msg)
        value = parse_value(text, assignment)
        return self.with_parameters({item.full_name: {parameter: value} for item in meant})

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

    own_arguments: beside RUN_ARGUMENTS.  container: name of the one that it runs in.  label:
    stands before errors.
    """

    function: Callable[[Mapping[str, Any]], Sequence[Component]]
    own_arguments: tuple[Argument, ...]
    container: str
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
        check_use(self.own_arguments, values, given or {}, self.label)
        own = {item.name: values[item.name] for item in self.own_arguments}
        found = Graph(tuple(self.function(own)), self.container)
        self._check(found)
        if values["params_file"]:
            names = [component.full_name for component in found.components]
            file = Path(values["params_file"])
            found = found.with_parameters(parameters_of_nodes(file, names))
        return replace(found, viewer=_viewer(found, values)) if values["view"] else found

    def _check(self, found: Graph) -> None:
        if not found.components:
            msg = f"{self.label}found no component, expected at least one"
            raise GraphError(msg)
        try:
            for component in found.components:
                component.check()
        except ComponentLoadError as error:
            msg = f"{self.label}{error}"
            raise GraphError(msg) from None
        for kind, names in (
            ("component", [item.full_name for item in found.components]),
            ("sensor", [item.name for item in found.sensors]),
        ):
            twice = [name for number, name in enumerate(names) if name in names[:number]]
            if twice:
                msg = f"{self.label}found {twice[0]!r} twice, expected another name for each {kind}"
                raise GraphError(msg)


def _viewer(found: Graph, values: Mapping[str, Any]) -> dict[str, Value]:
    """Parameters of the node web_viewer for the sensors of a graph, at their mounting poses."""
    mounts = {
        item.sensor: [
            *item.parameters.get("mount_position", [0.0] * 3),
            *item.parameters.get("mount_orientation", [0.0] * 3),
        ]
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
    *arguments: Argument, container: str = "tactile_container"
) -> Callable[[Callable[[Mapping[str, Any]], Sequence[Component]]], GraphFunction]:
    """Make a graph of a function that takes the values of its arguments by name.

    The function returns the components in the order in which they are loaded; its description
    begins with a line about the graph.
    """
    return lambda function: GraphFunction(function, arguments, container)


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


def parameters_of_nodes(path: Path, full_names: Sequence[str]) -> dict[str, dict[str, Value]]:
    """What a ROS parameter file sets, by the full name of the node.

    `/**` stands for any parts of a name, `*` for one; what stands further down takes precedence.

    Raises GraphError for a file that cannot be used, and for an entry that fits none of the nodes.
    """
    try:
        entries = list(_entries(read_yaml(path), ""))
    except DescriptionError as error:
        raise GraphError(str(error)) from None
    found: dict[str, dict[str, Value]] = {}
    for pattern, parameters in entries:
        text = re.escape(pattern)
        expression = text.replace(r"/\*\*", "(?:/[^/]+)*").replace(r"\*", "[^/]+")
        nodes = [name for name in full_names if re.fullmatch(expression, name)]
        if not nodes:
            names = ", ".join(full_names)
            msg = f"{path}: found parameters of {pattern}, expected a node of {names}"
            raise GraphError(msg)
        for name in nodes:
            found.setdefault(name, {}).update(parameters)
    return found


def _entries(section: YamlSection, above: str) -> Iterator[tuple[str, dict[str, Value]]]:
    for key, value in section.items():
        if key == PARAMETERS:
            inner = section.section(key)
            yield above or "/**", dict(_flat(inner, ""))
        elif not isinstance(value, dict):
            raise section.error(key, value, f"a mapping with {PARAMETERS}")
        else:
            yield from _entries(section.section(key), f"{above}/{key.strip('/')}")


def _flat(section: YamlSection, prefix: str) -> Iterator[tuple[str, Value]]:
    """Parameters with those of nested mappings as `outer.inner`."""
    for key, value in section.items():
        if isinstance(value, dict):
            yield from _flat(section.section(key), f"{prefix}{key}.")
            continue
        kinds = {type(item) for item in value} if isinstance(value, list) else {type(value)}
        if len(kinds) != 1 or not kinds <= {bool, int, float, str}:
            raise section.error(key, value, "a boolean, number, text or list of one kind")
        yield f"{prefix}{key}", value
