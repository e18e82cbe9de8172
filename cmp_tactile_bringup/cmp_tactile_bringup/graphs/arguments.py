"""What a user may set of a graph: arguments, and parameters of its nodes in a ROS file."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.errors import GraphError
from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.sensor.yaml_section import YamlSection, did_you_mean, read_yaml
from cmp_tactile_processing.sensor.yaml_text import yaml_value

TYPES = {str: "text", bool: "boolean", int: "integer", float: "number"}
PARAMETERS = "ros__parameters"

Value = bool | int | float | str | list[bool] | list[int] | list[float] | list[str]


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

    def convert(self, given: Value, label: str = "") -> Any:
        """The value, of the argument's type also where it is given as a text.

        label: stands before errors.  Raises GraphError for any other value.
        """
        kind, value = type(self.default), given
        if isinstance(value, str) and kind is not str:
            value = _value_of(value)
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is kind and not (self.choices and value not in self.choices):
            return value
        expected = f"one of {', '.join(self.choices)}" if self.choices else f"a {TYPES[kind]}"
        msg = f"{label}argument {self.name}: found {given!r}, expected {expected}"
        raise GraphError(msg)


def _value_of(text: str) -> Any:
    try:
        return yaml_value(text)
    except DescriptionError:
        return None


def argument_values(
    declared: Sequence[Argument], given: Mapping[str, Value], label: str = ""
) -> dict[str, Any]:
    """The value of each declared argument.

    label: stands before errors.  Raises GraphError for a wrong value, or a name that is not
    declared.
    """
    names = [argument.name for argument in declared]
    for name in given:
        if name not in names:
            allowed = ", ".join(names)
            near = did_you_mean(name, names)
            msg = f"{label}found argument {name!r}, expected one of: {allowed}{near}"
            raise GraphError(msg)
    return {item.name: item.convert(given.get(item.name, item.default), label) for item in declared}


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


def argument_rows(arguments: Iterable[Argument]) -> Iterator[str]:
    """The rows of a Markdown table of arguments."""
    yield "| argument | default | allowed | meaning |\n|---|---|---|---|"
    for item in arguments:
        default = f"`{item.default_text}`" if item.default_text else "empty"
        allowed = ", ".join(item.allowed) or TYPES[type(item.default)]
        yield f"| `{item.name}` | {default} | {allowed} | {item.description} |"


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
