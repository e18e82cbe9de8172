"""Graph files: which components make up a sensor, and with which names and parameters.

The one home of a graph is its YAML file; the launch files and `standalone` both load it here.

    version: 1
    arguments:                       # what a user may set; types: see graph_arguments.py
      rate: {type: number, default: 1.0, description: speed of the replay}
    sensor_description: $(sensor)    # file or name of a packaged one
    namespace: $(namespace)          # empty: the sensor's name
    container: tactile_container
    components:
      - include: parts/processing.yaml    # the components of another file, relative to this one
      - package: cmp_tactile_driver
        plugin: cmp_tactile_driver::Replay
        name: replay
        needs_view: right                 # absent from the graph of a sensor without that view
        remappings: {image_raw: camera/image_raw}
        parameters: {rate: $(rate)}

`$(NAME)` stands for an argument; a value that is nothing else keeps the argument's type.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from cmp_tactile_bringup.errors import GraphError
from cmp_tactile_bringup.graph_arguments import (
    Argument,
    Value,
    argument_values,
    arguments_of,
    parse_value,
)
from cmp_tactile_bringup.recording import sensor_of_recording, sensor_of_scene
from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.sensor_library import (
    find_sensor_description,
    load_sensor,
    packaged_sensors,
)
from cmp_tactile_processing.yaml_section import YamlSection, read_yaml

__all__ = [
    "ROS_NAME",
    "ROS_NAMESPACE",
    "Argument",
    "Component",
    "Graph",
    "load_graph",
    "read_arguments",
]

FORMAT_VERSION = 1
VIEW_NAMES = ("left", "right")
ARGUMENT = re.compile(r"\$\((\w+)\)")
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


@dataclass(frozen=True)
class Graph:
    """A container and its components, in the order in which they are loaded."""

    path: Path
    sensor_description: Path
    namespace: str
    container: str
    components: tuple[Component, ...]

    def with_parameter(self, assignment: str) -> Graph:
        """The graph with `COMPONENT.PARAMETER=VALUE` set, VALUE in YAML.

        Raises GraphError for anything else and for a component that the graph lacks.
        """
        target, equals, text = assignment.partition("=")
        owner, dot, parameter = target.partition(".")
        if not (equals and dot and parameter):
            msg = f"found {assignment!r}, expected COMPONENT.PARAMETER=VALUE"
            raise GraphError(msg)
        names = [component.name for component in self.components]
        if owner not in names:
            msg = f"{assignment}: found component {owner!r}, expected one of {', '.join(names)}"
            raise GraphError(msg)
        value = parse_value(text, assignment)
        changed = tuple(
            replace(item, parameters={**item.parameters, parameter: value})
            if item.name == owner
            else item
            for item in self.components
        )
        return replace(self, components=changed)


def read_arguments(path: Path) -> tuple[Argument, ...]:
    """The arguments that a graph file declares.

    Raises DescriptionError naming file, key, found and expected.
    """
    return arguments_of(read_yaml(path))


def load_graph(path: Path, arguments: Mapping[str, Value | str] | None = None) -> Graph:
    """The graph of a file with its arguments filled in.

    arguments: values by name; texts, as a command line gives them, are converted to the
    argument's type.
    Raises DescriptionError for the file, GraphError for the arguments.
    """
    top = read_yaml(path)
    if top.raw("version", str(FORMAT_VERSION)) != FORMAT_VERSION:
        raise top.error("version", top.raw("version"), str(FORMAT_VERSION))
    declared = arguments_of(top)
    values = argument_values(path, declared, arguments or {})
    sensor = _text(top, "sensor_description", values) or _own_sensor(path, declared, values)
    try:
        sensor_path = find_sensor_description(sensor).resolve()
        sensor_of_graph = load_sensor(str(sensor_path))
    except DescriptionError as error:
        msg = f"{path}: sensor_description: {error}"
        raise GraphError(msg) from None
    namespace = _namespace(top, values) or sensor_of_graph.ros_name
    values["sensor_description"] = str(sensor_path)
    container = _text(top, "container", values)
    found = [
        (_needed_view(section), _read_component(section, values, namespace))
        for section in _component_sections(path, top)
    ]
    views = ("", *sensor_of_graph.views)
    components = tuple(component for view, component in found if view in views)
    top.finish()
    if not components:
        raise top.error("components", [], "at least one component")
    _check_names(top, components)
    return Graph(path, sensor_path, f"/{namespace.strip('/')}", container, components)


def _own_sensor(path: Path, declared: Sequence[Argument], values: Mapping[str, Value]) -> str:
    """The sensor description of what is to be played, where none is told."""
    kinds = {argument.type: str(values[argument.name]) for argument in declared}
    if "scene" in kinds:
        return sensor_of_scene(kinds["scene"])
    sensor = sensor_of_recording(kinds["recording"]) if "recording" in kinds else ""
    if not sensor:
        expected = f"the file of a description or one of {', '.join(packaged_sensors())}"
        msg = f"{path}: argument sensor: found nothing, expected {expected}"
        raise GraphError(msg)
    return sensor


def _component_sections(path: Path, top: YamlSection) -> Iterator[YamlSection]:
    """The components of the file, and in the place of `include: FILE` those of that file."""
    for section in top.sections("components"):
        if "include" not in section:
            yield section
            continue
        included = read_yaml(path.parent / section.text("include"))
        section.finish()
        yield from included.sections("components")
        included.finish()


def _needed_view(section: YamlSection) -> str:
    """The view without which a sensor has no use for the component; empty where it needs none."""
    return section.choice("needs_view", VIEW_NAMES) if "needs_view" in section else ""


def _read_component(section: YamlSection, values: Mapping[str, Value], namespace: str) -> Component:
    name = _text(section, "name", values)
    if not ROS_NAME.fullmatch(name):
        raise section.error("name", name, "letters, digits, single underscores")
    own = _namespace(section, values)
    absolute = own if own.startswith("/") else f"{namespace}/{own}"
    component = Component(
        package=section.text("package"),
        plugin=section.text("plugin"),
        name=name,
        namespace=f"/{absolute.strip('/')}",
        remappings={key: str(value) for key, value in _items(section, "remappings", values)},
        parameters=dict(_items(section, "parameters", values)),
    )
    section.finish()
    return component


def _items(section: YamlSection, key: str, values: Mapping[str, Value]) -> list[tuple[str, Value]]:
    inner = section.optional_section(key)
    if inner is None:
        return []
    found = []
    for name, raw in inner.items():
        value = _fill(inner, name, raw, values) if isinstance(raw, str) else raw
        if isinstance(value, dict) or value is None:
            raise inner.error(name, value, "a boolean, number, text or list")
        found.append((name, value))
    return found


def _text(section: YamlSection, key: str, values: Mapping[str, Value]) -> str:
    return str(_fill(section, key, section.text(key), values))


def _namespace(section: YamlSection, values: Mapping[str, Value]) -> str:
    if "namespace" not in section:
        return ""
    value = str(_fill(section, "namespace", section.text("namespace"), values))
    if not ROS_NAMESPACE.fullmatch(value):
        raise section.error(
            "namespace", value, "names of letters, digits, single underscores, joined by /"
        )
    return value


def _fill(section: YamlSection, key: str, text: str, values: Mapping[str, Value]) -> Value:
    """The text with arguments filled in; a text that is one argument alone gives its value."""
    for name in ARGUMENT.findall(text):
        if name not in values:
            allowed = ", ".join(values)
            raise section.error(key, text, f"$(NAME) with NAME one of: {allowed}")
    alone = ARGUMENT.fullmatch(text)
    if alone:
        return values[alone[1]]
    return ARGUMENT.sub(lambda match: str(values[match[1]]), text)


def _check_names(top: YamlSection, components: tuple[Component, ...]) -> None:
    seen = set()
    for component in components:
        full = f"{component.namespace}/{component.name}"
        if full in seen:
            raise top.error("components", full, "every component with a name of its own")
        seen.add(full)
