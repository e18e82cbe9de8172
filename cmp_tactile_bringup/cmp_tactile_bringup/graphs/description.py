"""Graphs: which components make up one sensor or several, with which names and parameters.

A graph is one Python function that returns a list of components; `graph` decorates it with what a
user may set when it is started.  Launch files and `standalone` both load it, packaged ones by name
and others by the path of their file.
"""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.errors import ComponentLoadError, GraphError
from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.sensor.yaml_section import YamlSection, did_you_mean, read_yaml
from cmp_tactile_processing.sensor.yaml_text import yaml_value

TYPES: dict[str, type | tuple[type, ...]] = {
    "text": str,
    "path": str,
    "recording": str,
    "scene": str,
    "pose": (str, list, tuple),
    "number": (int, float),
    "integer": int,
    "boolean": bool,
}
# recording, scene: a path, or the name of a packaged scene.
PLACES = ("path", "recording", "scene")
# Types whose values are not written as YAML.
TEXTS = ("text", "pose", *PLACES)

Value = (
    bool | int | float | str | list[bool] | list[int] | list[float] | list[str] | tuple[float, ...]
)


@dataclass(frozen=True)
class Condition:
    """That an argument has one of some values; without values, that it is not empty."""

    argument: str
    values: tuple[str, ...] = ()

    def holds(self, value: object) -> bool:
        """Whether it holds where the argument has that value."""
        return value in self.values if self.values else value != ""

    def __str__(self) -> str:
        return f"{self.argument}:={' or '.join(self.values) or '...'}"


@dataclass(frozen=True)
class Argument:
    """What a user may set.

    type: text; path; recording or scene, a path or the name of a packaged scene; pose, six numbers
    in m and rad; number; integer; boolean.  default: None where the user must set it.  choices:
    empty for any value.  only_with: conditions without which it has no effect.
    """

    name: str
    type: str
    description: str
    default: Value | None = None
    choices: tuple[str, ...] = ()
    only_with: tuple[Condition, ...] = ()

    def __post_init__(self) -> None:
        if self.type not in TYPES:
            msg = f"argument {self.name}: found type {self.type!r}, expected one of: "
            raise GraphError(msg + ", ".join(TYPES))
        if self.default is not None and not _is_a(self.type, self.default):
            msg = f"argument {self.name}: found default {self.default!r}, expected a {self.type}"
            raise GraphError(msg)

    @property
    def help(self) -> str:
        """The description, and when the argument has an effect."""
        if not self.only_with:
            return self.description
        return f"{self.description}; only with {', '.join(str(item) for item in self.only_with)}"

    @property
    def allowed(self) -> tuple[str, ...]:
        """The choices, also those of a boolean."""
        return self.choices or (("true", "false") if self.type == "boolean" else ())

    @property
    def default_text(self) -> str | None:
        """The default as a command line gives it."""
        return None if self.default is None else _text(self.default)


def argument_values(
    declared: Sequence[Argument], given: Mapping[str, Value], label: str = ""
) -> dict[str, Any]:
    """The value of each declared argument; texts are converted to the argument's type.

    A pose becomes six numbers: x, y, z in m; roll, pitch, yaw in rad.
    label: stands before errors.  Raises GraphError for a name that is not declared, a value that
    is missing or wrong.
    """
    names = [argument.name for argument in declared]
    for name in given:
        if name not in names:
            allowed = ", ".join(names) or "none"
            near = did_you_mean(name, names)
            msg = f"{label}found argument {name!r}, expected one of: {allowed}{near}"
            raise GraphError(msg)
    values = {}
    for argument in declared:
        value = given.get(argument.name, argument.default)
        if value is None:
            msg = f"{label}argument {argument.name!r} is missing ({argument.description})"
            raise GraphError(msg)
        values[argument.name] = _convert(argument, value, label)
    return values


def check_use(
    declared: Iterable[Argument], values: Mapping[str, Any], given: Mapping[str, Value], label: str
) -> None:
    """Raise GraphError for the first argument that was set though it has no effect."""
    for argument in declared:
        default = argument.default
        if default is None or values[argument.name] == _convert(argument, default, label):
            continue
        for condition in argument.only_with:
            found = values[condition.argument]
            if not condition.holds(found):
                msg = (
                    f"{label}argument {argument.name}: found {_shown(given[argument.name])}, which "
                    f"has no effect with {condition.argument}:={_shown(found)}, expected it with "
                    f"{condition}"
                )
                raise GraphError(msg)


def parse_value(text: str, where: str) -> Any:
    """A value written as YAML: true, 3, 0.5, word, [1, 2].

    Raises GraphError, which begins with `where`, for anything else.
    """
    try:
        value = yaml_value(text)
    except DescriptionError:
        value = None
    single = not isinstance(value, (list, dict)) and value is not None
    if single or (isinstance(value, list) and value and len({type(v) for v in value}) == 1):
        return value
    msg = f"{where}: found {text!r}, expected a boolean, number, text or list of one kind"
    raise GraphError(msg)


def argument_list(arguments: Iterable[Argument]) -> str:
    """What `--show-args` writes."""
    lines = []
    for argument in arguments:
        default = "required" if argument.default is None else repr(argument.default_text)
        choices = f" (one of {', '.join(argument.allowed)})" if argument.allowed else ""
        lines += [f"{argument.name}:={choices}", f"    {argument.help}", f"    default: {default}"]
    return "\n".join(lines) + "\n"


def argument_rows(arguments: Iterable[Argument]) -> Iterator[str]:
    """The rows of a Markdown table of arguments."""
    yield "| argument | default | allowed | meaning |\n|---|---|---|---|"
    for item in arguments:
        default = f"`{item.default_text}`" if item.default_text else "empty"
        if item.default is None:
            default = "must be given"
        kind = {"boolean": "", "recording": "path or scene", "scene": "path or scene"}
        allowed = ", ".join(item.allowed) or kind.get(item.type, item.type)
        yield f"| `{item.name}` | {default} | {allowed} | {item.help} |"


def _is_a(kind: str, value: object) -> bool:
    if isinstance(value, bool):
        return kind == "boolean"
    return isinstance(value, TYPES[kind])


def _convert(argument: Argument, given: Value, label: str) -> Any:
    value: Any = given
    where = f"{label}argument {argument.name}"
    if isinstance(value, str) and argument.type not in TEXTS:
        value = parse_value(value, where)
    if not _is_a(argument.type, value):
        msg = f"{where}: found {given!r}, expected a {argument.type}"
        raise GraphError(msg)
    if argument.choices and value not in argument.choices:
        msg = f"{where}: found {given!r}, expected one of {', '.join(argument.choices)}"
        raise GraphError(msg)
    if argument.type == "pose":
        return _pose(value, where)
    if argument.type == "number":
        return float(value)
    return _place(argument.type, value) if argument.type in PLACES and value else value


def _place(kind: str, value: str) -> str:
    """The absolute path; a recording or scene that is not there may be a packaged one's name."""
    if kind == "recording":
        return os.pathsep.join(_place("", part) for part in value.split(os.pathsep) if part)
    place = Path(value).expanduser()
    return value if kind != "path" and not place.exists() else str(place.resolve())


def _pose(given: str | Sequence[float], where: str) -> list[float]:
    words = given.replace(",", " ").split() if isinstance(given, str) else given
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != 6 or not all(math.isfinite(number) for number in numbers):
        expected = "six numbers, x y z in m and roll pitch yaw in rad"
        msg = f"{where}: found {given!r}, expected {expected}"
        raise GraphError(msg)
    return numbers


def _text(value: Value) -> str:
    if isinstance(value, tuple):
        return " ".join(f"{number:.9g}" for number in value)
    return str(value).lower() if isinstance(value, bool) else str(value)


def _shown(value: Value) -> str:
    return repr(value) if value == "" else _text(value)


# Two underscores in a row stand for themselves in ROS's remapping rules.
ROS_NAME = re.compile(r"(?!.*__)[A-Za-z_]\w*", re.ASCII)
ROS_NAMESPACE = re.compile(r"(?!.*__)(/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*|/?)", re.ASCII)
LETTERS = "letters, digits, single underscores"
# Constants of rcl_interfaces/Log; 0 for the default.
LOG_LEVELS = (0, 10, 20, 30, 40, 50)
PARAMETERS = "ros__parameters"

# What a user may set of every graph.
RUN_ARGUMENTS = (
    Argument(
        "params_file",
        "path",
        "ROS parameter file; its values take precedence; empty for none",
        default="",
    ),
    Argument("view", "boolean", "show the sensors in a browser (docs/viewer.md)", default=False),
    Argument(
        "view_host",
        "text",
        "address on which the page listens; 0.0.0.0 for the whole network",
        default="127.0.0.1",
    ),
    Argument(
        "view_port", "integer", "port of the page; 0 for the first free one from 8080 on", default=0
    ),
    Argument("view_token", "text", "that the address of the page must have", default=""),
    Argument(
        "view_allow_host",
        "text",
        "further names, separated by spaces, by which browsers reach the page",
        default="",
    ),
)
# Of the launch files alone.
LAUNCH_ARGUMENTS = (
    Argument(
        "container",
        "text",
        "full name of a running container to load into; empty to start one",
        default="",
    ),
    Argument("rviz", "boolean", "show the sensors in RViz", default=False),
)


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
                msg = f"{self.label}found {twice[0]!r} twice, expected every {kind} with a name "
                raise GraphError(msg + "of its own")


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
    spec = spec_from_file_location(name, path) if path.suffix == ".py" else None
    found: list[GraphFunction] = []
    if spec is not None and spec.loader is not None:
        module = module_from_spec(spec)
        sys.modules[name] = module
        try:
            spec.loader.exec_module(module)
        except Exception as error:
            msg = f"{path}: cannot be run: {type(error).__name__}: {error}"
            raise GraphError(msg) from error
        defined = [item for item in vars(module).values() if isinstance(item, GraphFunction)]
        found = [item for item in defined if item.function.__module__ == name]
    if len(found) != 1:
        expected = "a Python file with one function that `graph` decorates (docs/launch.md)"
        msg = f"{path}: found {len(found) or 'no'} graphs in it, expected {expected}"
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
            msg = f"{path}: found parameters of {pattern}, expected those of one of {names}"
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
