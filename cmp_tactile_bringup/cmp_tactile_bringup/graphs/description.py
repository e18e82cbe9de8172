"""Graphs: which components make up one sensor or several, with which names and parameters.

A graph is one Python function that returns a list of components; `graph` decorates it with what a
user may set when it is started.  Launch files and `standalone` both load it, packaged ones by name
and others by the path of their file.
"""

from __future__ import annotations

import os
import re
import runpy
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.recordings.library import recorded_source
from cmp_tactile_driver.bags.recording import open_recording_of
from cmp_tactile_processing.cache.files import expanded_path, split_paths
from cmp_tactile_processing.errors import CmpTactileError, FrameSourceError, InputError
from cmp_tactile_processing.processes import OnProgress, no_progress
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.sensor.yaml_file import YamlFile, did_you_mean, read_yaml
from cmp_tactile_processing.sensor.yaml_text import yaml_value

TYPES = {str: "text", bool: "boolean", int: "integer", float: "number"}
PARAMETERS = "ros__parameters"
Value = bool | int | float | str | list[bool] | list[int] | list[float] | list[str]
__all__ = ["Argument", "Component", "Graph", "GraphFunction", "GraphSensor", "graph"]
CONTAINER = "tactile_container"
"""Name of the container that is started for a sensor."""
GRIPPER_FRAME, WORLD_FRAME = "gripper_frame", "world_frame"
"""Parameters of a component that simulates a gripper."""
GRASP_STATE = "grasp_state"
"""Name of the node of two fingers, and of its topic."""
REPLAY = "cmp_tactile_driver::Replay"
RECORDER = "cmp_tactile_driver::Recorder"


@dataclass(frozen=True)
class Argument:
    """What a user may set, of the type of its default.

    choices: empty for any value.
    """

    name: str
    description: str
    default: bool | int | float | str = ""
    choices: tuple[str, ...] = ()

    @property
    def allowed(self) -> tuple[str, ...]:
        """The choices, also those of a boolean."""
        return self.choices or (("true", "false") if isinstance(self.default, bool) else ())

    @property
    def default_text(self) -> str:
        """The default as a command line gives it."""
        return as_text(self.default)

    def convert(self, given: Value) -> Any:
        """The value, of the argument's type also where it is given as a text.

        Raises InputError for any other value.
        """
        kind, value = type(self.default), given
        # Names of files may be in another encoding, which messages of ROS cannot contain.
        if isinstance(value, str) and value.encode(errors="ignore").decode() != value:
            msg = f"argument {self.name}: found {given!r}, expected text in UTF-8"
            raise InputError(msg)
        if isinstance(value, str) and kind is not str:
            value = _value_of(value)
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is kind and not (self.choices and value not in self.choices):
            return value
        expected = f"one of {', '.join(self.choices)}" if self.choices else f"a {TYPES[kind]}"
        msg = f"argument {self.name}: found {given!r}, expected {expected}"
        raise InputError(msg)


def _value_of(text: str) -> Any:
    try:
        return yaml_value(text)
    except InputError:
        return None


def argument_values(declared: Sequence[Argument], given: Mapping[str, Value]) -> dict[str, Any]:
    """The value of each declared argument.

    Raises InputError for a wrong value, or a name that is not declared.
    """
    names = [argument.name for argument in declared]
    for name in given:
        if name not in names:
            allowed, near = ", ".join(names), did_you_mean(name, names)
            msg = f"found argument {name!r}, expected one of: {allowed}{near}"
            raise InputError(msg)
    return {item.name: item.convert(given.get(item.name, item.default)) for item in declared}


def as_text(value: Value) -> str:
    """A value as a command line gives it."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def argument_list(arguments: Iterable[Argument]) -> str:
    """What `--show-args` writes."""
    lines = []
    for item in arguments:
        choices = f" (one of {', '.join(item.allowed)})" if item.allowed else ""
        lines += [f"{item.name}:={choices}", f"    {item.description}"]
        lines.append(f"    default: {item.default_text!r}")
    return "\n".join(lines) + "\n"


# What a user may set of every graph.
RUN_ARGUMENTS = (
    Argument("params_file", "ROS parameter file, which takes precedence; empty for none"),
    Argument("view", "show the sensors in a browser (docs/viewer.md)", default=False),
    Argument(
        "view_host",
        "address on which the page listens; 0.0.0.0 for all interfaces",
        default="127.0.0.1",
    ),
    Argument("view_port", "port of the page; 0 for the first free one from 8080 on", default=0),
    Argument("view_token", "word that the page's address must contain; empty for none"),
    Argument("view_allow_host", "further host names of the page, separated by spaces"),
)
# Of the launch files alone.
LAUNCH_ARGUMENTS = (
    Argument(
        "container", "full name of a running container to load the nodes into; empty to start one"
    ),
    Argument("rviz", "show the sensors in RViz", default=False),
)


def parameters_of_nodes(path: Path, full_names: Sequence[str]) -> dict[str, dict[str, Value]]:
    """What a ROS parameter file sets, by the full name of the node.

    `/**` stands for any parts of a name, `*` for one; what stands further down takes precedence.

    Raises InputError for a file that cannot be used, and for an entry that fits none of the nodes.
    """
    file = read_yaml(path)
    entries = list(_entries(file, file.content, ()))
    found: dict[str, dict[str, Value]] = {}
    for pattern, parameters in entries:
        text = re.escape(pattern)
        expression = text.replace(r"/\*\*", "(?:/[^/]+)*").replace(r"\*", "[^/]+")
        nodes = [name for name in full_names if re.fullmatch(expression, name)]
        if not nodes:
            names = ", ".join(full_names)
            msg = f"{path}: found parameters of {pattern}, expected a node of {names}"
            raise InputError(msg)
        for name in nodes:
            found.setdefault(name, {}).update(parameters)
    return found


def _entries(
    file: YamlFile, content: Mapping[str, Any], keys: tuple[str, ...]
) -> Iterator[tuple[str, dict[str, Value]]]:
    """Patterns of node names and what they set.  keys: of the content in the file."""
    for key, value in content.items():
        below = (*keys, key)
        if not isinstance(value, dict):
            raise file.error(".".join(below), value, f"a mapping with {PARAMETERS}")
        if key == PARAMETERS:
            name = "".join(f"/{item.strip('/')}" for item in keys)
            yield name or "/**", dict(_flat(file, value, below, ""))
        else:
            yield from _entries(file, value, below)


def _flat(
    file: YamlFile, content: Mapping[str, Any], keys: tuple[str, ...], prefix: str
) -> Iterator[tuple[str, Value]]:
    """Parameters with those of nested mappings as `outer.inner`."""
    for key, value in content.items():
        if isinstance(value, dict):
            yield from _flat(file, value, (*keys, key), f"{prefix}{key}.")
            continue
        kinds = {type(item) for item in value} if isinstance(value, list) else {type(value)}
        if len(kinds) != 1 or not kinds <= {bool, int, float, str}:
            where = ".".join((*keys, key))
            raise file.error(where, value, "a boolean, number, text or list of one kind")
        yield f"{prefix}{key}", value


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
    process: of what belongs to no sensor, namespace of its own process; empty for that of the first
    sensor.
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
    process: str = ""

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

    def first_of(self, parameter: str) -> str:
        """The first component's value of a parameter that it has; empty where none has it."""
        found = (item.parameters.get(parameter, "") for item in self.components)
        return str(next(filter(None, found), ""))

    @property
    def namespace(self) -> str:
        """Where its container is: of the process, or of the first component."""
        return absolute_name(self.components[0].process or self.components[0].namespace)

    def by_process(self) -> tuple[Graph, ...]:
        """A graph for each process: Python runs on one core in a process.

        Each sensor has one; what has neither sensor nor process is loaded with the first one.
        """
        first = self.sensors[0].namespace if self.sensors else ""
        processes = [
            item.sensor.namespace if item.sensor else item.process or first
            for item in self.components
        ]
        return tuple(
            replace(
                self,
                components=tuple(
                    item
                    for item, process in zip(self.components, processes, strict=True)
                    if process == own
                ),
            )
            for own in dict.fromkeys(processes)
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

    def load(self, given: Mapping[str, Value] | None = None) -> Graph:
        """The graph with these arguments.

        given: values by name; texts, as a command line gives them, are converted to the argument's
        type.  Raises InputError for arguments, names and parameter file that cannot be used.
        """
        try:
            return self._load(argument_values(self.arguments, given or {}))
        except InputError as error:
            msg = f"{self.label}{error}"
            raise InputError(msg) from None

    def _load(self, values: Mapping[str, Any]) -> Graph:
        own = {item.name: values[item.name] for item in self.own_arguments}
        found = Graph(tuple(self.function(own)))
        names = [component.full_name for component in found.components]
        twice = [name for number, name in enumerate(names) if name in names[:number]]
        if twice or not names:
            wrong = f"{twice[0]!r} twice" if twice else "no component"
            msg = f"found {wrong}, expected components with different names"
            raise InputError(msg)
        if values["params_file"]:
            file = expanded_path(values["params_file"])
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
        "grasp": next((i.full_name for i in found.components if i.name == GRASP_STATE), ""),
        "scene_frame": found.first_of(WORLD_FRAME),
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

    Raises InputError for a file that cannot be run or does not define just one.
    """
    name = f"cmp_tactile_graph_{path.stem}"
    try:
        defined = runpy.run_path(str(path), run_name=name) if path.suffix == ".py" else {}
    except Exception as error:
        msg = f"{path}: cannot be run: {type(error).__name__}: {error}"
        raise InputError(msg) from error
    graphs = (item for item in defined.values() if isinstance(item, GraphFunction))
    found = [item for item in graphs if item.function.__module__ == name]
    if len(found) != 1:
        expected = "one: a Python file with one function that `graph` decorates (docs/launch.md)"
        msg = f"{path}: found {len(found) or 'no'} graphs, expected {expected}"
        raise InputError(msg)
    return replace(found[0], label=f"{path}: ")


def absolute_name(namespace: str, below: str = "") -> str:
    """The absolute name of a namespace; a relative one is below another."""
    absolute = namespace if namespace.startswith("/") else f"{below}/{namespace}"
    return f"/{absolute.strip('/')}"


def with_recordings(graph: Graph, progress: OnProgress = no_progress) -> Graph:
    """The graph with the names of packaged scenes replaced by their recordings.

    One that was never asked for before is simulated first.  All replays begin together.  Raises
    CmpTactileError where a scene cannot be simulated.
    """
    replays = [item for item in graph.components if item.plugin == REPLAY]
    names = {item.full_name for item in replays}
    parameters: dict[str, dict[str, Value]] = {}
    for item in replays:
        paths = [_recorded(scene, progress) for scene in _inputs(item)]
        changed: dict[str, Value] = {"input": os.pathsep.join(paths)}
        if len(replays) > 1:
            changed["begin_with"] = " ".join(sorted(names - {item.full_name}))
        parameters[item.full_name] = changed
    return graph.with_parameters(parameters)


def _recorded(scene: Path, progress: OnProgress) -> str:
    def show(what: str, share: float) -> None:
        progress(f"{scene}: {what}, the first time only", share)

    return str(recorded_source(scene, show))


def check_recordings(graph: Graph) -> None:
    """Open each recording that is to be replayed, before anything that takes long is built.

    Raises CmpTactileError for the first that cannot be opened, or is to be made and is there.
    """
    for component in graph.components:
        output = component.parameters.get("output") if component.plugin == RECORDER else None
        if output and expanded_path(str(output)).exists():
            msg = f"{component.full_name} ({RECORDER}): {output}: found an existing folder or file"
            raise CmpTactileError(f"{msg}, expected a new name")
        try:
            for path in _inputs(component):
                sensor = load_sensor(str(component.parameters["sensor_description"]))
                topic = str(component.parameters.get("topic", ""))
                open_recording_of(sensor, path, topic=topic, any_size=True)
        except FrameSourceError as error:
            raise CmpTactileError(f"{component.label}: {error}") from None


def _inputs(component: Component) -> list[Path]:
    """What a replay component plays; empty for any other component."""
    if component.plugin != REPLAY:
        return []
    return split_paths(str(component.parameters.get("input", "")))
