"""Arguments of graphs: what a user may set, with types, conditions and tables for documents."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.errors import GraphError
from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.sensor.yaml_section import did_you_mean
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
            msg = (
                f"{label}argument {argument.name!r}: found nothing, expected a value "
                f"({argument.description})"
            )
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
                    f"{label}argument {argument.name}: found {_shown(given[argument.name])}, "
                    f"which has no effect with {condition.argument}:={_shown(found)}, expected "
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


# What a user may set of every graph.
RUN_ARGUMENTS = (
    Argument(
        "params_file",
        "path",
        "ROS parameter file, which takes precedence; empty for none",
        default="",
    ),
    Argument("view", "boolean", "show the sensors in a browser (docs/viewer.md)", default=False),
    Argument(
        "view_host",
        "text",
        "address on which the page listens; 0.0.0.0 for all interfaces",
        default="127.0.0.1",
    ),
    Argument(
        "view_port", "integer", "port of the page; 0 for the first free one from 8080 on", default=0
    ),
    Argument(
        "view_token",
        "text",
        "word that the page's address must contain; empty for none",
        default="",
    ),
    Argument(
        "view_allow_host",
        "text",
        "further host names of the page, separated by spaces",
        default="",
    ),
)
# Of the launch files alone.
LAUNCH_ARGUMENTS = (
    Argument(
        "container",
        "text",
        "full name of a running container to load the nodes into; empty to start one",
        default="",
    ),
    Argument("rviz", "boolean", "show the sensors in RViz", default=False),
)
