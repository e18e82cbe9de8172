"""Graph files: which components make up one sensor or several, with which names and parameters.

The one home of a graph is its YAML file; the launch files and `standalone` both load it here.

    version: 1
    arguments:                       # what a user may set; types: see graphs/arguments.py
      rate: {type: number, default: 1.0, description: speed of the replay}
      record: {type: path, default: "", description: folder of a recording}
    sensor_description: $(sensor)    # file or name of a packaged one
    sensor_name: $(name)             # optional: of this one of several that share a description
    namespace: $(namespace)          # empty: the sensor's name
    container: tactile_container
    components:
      - include: parts/processing.yaml    # the components of another file, relative to this one
      - package: cmp_tactile_driver
        plugin: cmp_tactile_driver::Replay
        name: replay
        needs_view: right                 # absent from the graph of a sensor without that view
        load: last                        # after all components that do not say so
        remappings: {image_raw: camera/image_raw}
        parameters: {rate: $(rate)}
      - include: parts/recorder.yaml
        unless: {record: ""}              # or `when`: only where arguments have these values
        arguments: {output: $(record)}    # values of the other file's arguments
        prefix: slow_                     # those not given are this file's too: slow_compression
        defaults: {compression: none}     # other defaults of them

A file that is included may name a sensor of its own; its namespace is then below the including
file's.  `$(NAME)` stands for an argument, or for `sensor_description` or `sensor_name`; a value
that is nothing else keeps the argument's type.  `$(NAME.position)` and `$(NAME.orientation)` are
those of an argument of type pose.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.errors import GraphError
from cmp_tactile_bringup.graphs.arguments import (
    Argument,
    Value,
    argument_values,
    check_use,
    parse_value,
)
from cmp_tactile_bringup.graphs.file import GraphFile, Include, fill, fill_text, read_graph_file
from cmp_tactile_bringup.recordings.library import (
    RecordingError,
    check_source,
    sensor_of_recordings,
    sensor_of_scene,
)
from cmp_tactile_driver.bags.recording import split_inputs
from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.sensor.library import (
    find_sensor_description,
    load_sensor,
    packaged_sensors,
)
from cmp_tactile_processing.sensor.yaml_section import YamlSection

__all__ = [
    "ROS_NAME",
    "ROS_NAMESPACE",
    "Argument",
    "Component",
    "Graph",
    "GraphSensor",
    "load_graph",
    "read_arguments",
]

FORMAT_VERSION = 1
VIEW_NAMES = ("left", "right")
# What every component of a sensor may refer to beside arguments.
SENSOR_VALUES = ("sensor_description", "sensor_name")
# Two underscores in a row stand for themselves in ROS's remapping rules.
ROS_NAME = re.compile(r"(?!.*__)[A-Za-z_]\w*", re.ASCII)
ROS_NAMESPACE = re.compile(r"(?!.*__)(/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*|/?)", re.ASCII)


@dataclass(frozen=True)
class Component:
    """One component of a graph.  namespace: absolute.  remappings: from old to new name."""

    package: str
    plugin: str
    name: str
    namespace: str
    remappings: Mapping[str, str] = field(default_factory=dict)
    parameters: Mapping[str, Value] = field(default_factory=dict)

    @property
    def full_name(self) -> str:
        """Namespace and name."""
        return f"{self.namespace.rstrip('/')}/{self.name}"


@dataclass(frozen=True)
class GraphSensor:
    """A sensor of a graph.  name: with which its tf frames begin.  namespace: absolute."""

    name: str
    namespace: str
    description: Path
    views: tuple[str, ...]


@dataclass(frozen=True)
class Graph:
    """A container and its components, in the order in which they are loaded."""

    path: Path
    sensors: tuple[GraphSensor, ...]
    namespace: str
    container: str
    components: tuple[Component, ...]

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


def read_arguments(path: Path) -> tuple[Argument, ...]:
    """The arguments of a graph: those of its file, and those of what that includes.

    Raises DescriptionError naming file, key, found and expected.
    """
    return read_graph_file(path).arguments()


def load_graph(path: Path, arguments: Mapping[str, Value | str] | None = None) -> Graph:
    """The graph of a file with its arguments filled in.

    arguments: values by name; texts, as a command line gives them, are converted to the
    argument's type.
    Raises DescriptionError for the file, GraphError for the arguments.
    """
    file = read_graph_file(path)
    top = file.top
    if top.raw("version", str(FORMAT_VERSION)) != FORMAT_VERSION:
        raise top.error("version", top.raw("version"), str(FORMAT_VERSION))
    declared = file.arguments()
    values = argument_values(path, declared, arguments or {})
    check_use(path, declared, values)
    container = _text(top, "container", values)
    placed = sorted(_place_file(file, values, _Scope()), key=lambda item: item.last)
    if not placed:
        raise top.error("components", [], "at least one component")
    components = tuple(item.component for item in placed)
    sensors = tuple(dict.fromkeys(item.sensor for item in placed if item.sensor is not None))
    _check_names(top, components, sensors)
    namespace = _namespace(top, values)
    if not namespace and len(sensors) == 1:
        namespace = sensors[0].namespace
    return Graph(path, sensors, f"/{namespace.strip('/')}", container, components)


@dataclass(frozen=True)
class _Scope:
    """Where a file stands: its namespace, its sensor, what is before its arguments' names."""

    namespace: str = ""
    sensor: GraphSensor | None = None
    prefix: str = ""

    @property
    def views(self) -> tuple[str, ...]:
        return self.sensor.views if self.sensor is not None else ()

    def below(self, namespace: str) -> str:
        """The absolute name of a namespace here."""
        absolute = namespace if namespace.startswith("/") else f"{self.namespace}/{namespace}"
        return f"/{absolute.strip('/')}"


@dataclass(frozen=True)
class _Placed:
    """A component with its sensor; last: loaded after those that are not."""

    component: Component
    sensor: GraphSensor | None
    last: bool


def _place_file(file: GraphFile, values: dict[str, Value], scope: _Scope) -> Iterator[_Placed]:
    """The components of a file and of those that it includes."""
    top = file.top
    if "sensor_description" in top:
        scope = _sensor_scope(file, values, scope)
    elif "namespace" in top:
        scope = replace(scope, namespace=scope.below(_namespace(top, values)))
    top.finish()
    for entry in file.entries:
        holds = all(item.holds(values[item.argument]) for item in entry.conditions)
        if not isinstance(entry, Include):
            view, placed = _read_component(entry.section, values, scope)
            if holds and view in ("", *scope.views):
                yield placed
        elif holds:
            inner = entry.values(values)
            inner |= {name: values[name] for name in SENSOR_VALUES if name in values}
            prefix = scope.prefix + entry.prefix
            yield from _place_file(entry.file, inner, replace(scope, prefix=prefix))


def _sensor_scope(file: GraphFile, values: dict[str, Value], outside: _Scope) -> _Scope:
    """The scope of a file's own sensor, which the values are told of."""
    top = file.top
    description = _text(top, "sensor_description", values) or _own_sensor(file, values, outside)
    try:
        path = find_sensor_description(description).resolve()
        sensor = load_sensor(str(path))
    except DescriptionError as error:
        msg = f"{file.path}: sensor_description: {error}"
        raise GraphError(msg) from None
    name = _text(top, "sensor_name", values) if "sensor_name" in top else ""
    if name and not ROS_NAME.fullmatch(name):
        raise top.error("sensor_name", name, "letters, digits, single underscores")
    values |= {"sensor_description": str(path), "sensor_name": name}
    namespace = outside.below(_namespace(top, values) or name or sensor.ros_name)
    found = GraphSensor(name or sensor.ros_name, namespace, path, tuple(sensor.views))
    return replace(outside, namespace=namespace, sensor=found)


def _own_sensor(file: GraphFile, values: Mapping[str, Value], scope: _Scope) -> str:
    """The sensor description of what is to be played, where none is told."""
    used = [
        argument
        for argument in file.arguments()
        if all(item.holds(values[item.argument]) for item in argument.conditions)
    ]
    kinds = {argument.type: argument for argument in used}
    if "scene" in kinds:
        return sensor_of_scene(str(values[kinds["scene"].name]))
    played = kinds["recording"].name if "recording" in kinds else ""
    sources = split_inputs(str(values[played])) if played else []
    try:
        for source in sources:
            check_source(source)
    except RecordingError as error:
        msg = f"{file.path}: argument {scope.prefix}{played}: {error}"
        raise GraphError(msg) from None
    sensor = sensor_of_recordings(sources)
    if not sensor:
        expected = f"the file of a description or one of {', '.join(packaged_sensors())}"
        msg = f"{file.path}: argument {scope.prefix}sensor: found nothing, expected {expected}"
        raise GraphError(msg)
    return sensor


def _read_component(
    section: YamlSection, values: Mapping[str, Value], scope: _Scope
) -> tuple[str, _Placed]:
    """A component, and the view without which a sensor has no use for it, empty for none."""
    name = _text(section, "name", values)
    if not ROS_NAME.fullmatch(name):
        raise section.error("name", name, "letters, digits, single underscores")
    component = Component(
        package=section.text("package"),
        plugin=section.text("plugin"),
        name=name,
        namespace=scope.below(_namespace(section, values)),
        remappings={key: str(value) for key, value in _items(section, "remappings", values)},
        parameters=dict(_items(section, "parameters", values)),
    )
    view = section.choice("needs_view", VIEW_NAMES) if "needs_view" in section else ""
    last = "load" in section and bool(section.choice("load", ("last",)))
    section.finish()
    return view, _Placed(component, scope.sensor, last)


def _items(section: YamlSection, key: str, values: Mapping[str, Value]) -> list[tuple[str, Value]]:
    inner = section.optional_section(key)
    if inner is None:
        return []
    found = []
    for name, raw in inner.items():
        value: Any = fill(inner, name, raw, values)
        if isinstance(value, dict) or value is None:
            raise inner.error(name, value, "a boolean, number, text or list")
        found.append((name, value))
    return found


def _text(section: YamlSection, key: str, values: Mapping[str, Value]) -> str:
    return str(fill_text(section, key, section.text(key), values))


def _namespace(section: YamlSection, values: Mapping[str, Value]) -> str:
    if "namespace" not in section:
        return ""
    value = _text(section, "namespace", values)
    if not ROS_NAMESPACE.fullmatch(value):
        raise section.error(
            "namespace", value, "names of letters, digits, single underscores, joined by /"
        )
    return value


def _check_names(
    top: YamlSection, components: tuple[Component, ...], sensors: tuple[GraphSensor, ...]
) -> None:
    for kind, names in (
        ("component", [item.full_name for item in components]),
        ("sensor", [item.name for item in sensors]),
    ):
        for number, name in enumerate(names):
            if name in names[:number]:
                raise top.error("components", name, f"every {kind} with a name of its own")
