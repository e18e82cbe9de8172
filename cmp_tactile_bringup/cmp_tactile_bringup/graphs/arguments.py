"""Arguments of a graph file: what a user may set when the graph is started."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.errors import GraphError
from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.sensor.yaml_section import YamlSection, did_you_mean
from cmp_tactile_processing.sensor.yaml_text import yaml_value

__all__ = [
    "ARGUMENT_TYPES",
    "Argument",
    "Condition",
    "Value",
    "argument_values",
    "arguments_of",
    "check_use",
    "conditions_of",
    "fits",
    "parse_value",
]

ARGUMENT_TYPES: dict[str, type | tuple[type, ...]] = {
    "text": str,
    "path": str,
    "recording": str,
    "scene": str,
    "pose": str,
    "number": (int, float),
    "integer": int,
    "boolean": bool,
}
# recording, scene: a path, or the name of a packaged scene.
PLACES = ("path", "recording", "scene")
# Types whose values are not written as YAML.
TEXTS = ("text", "path", "pose")
POSE_PARTS = ("position", "orientation")

Value = bool | int | float | str | list[bool] | list[int] | list[float] | list[str]


@dataclass(frozen=True)
class Condition:
    """That an argument has one of some values; negated: that it has none of them."""

    argument: str
    values: tuple[Value, ...]
    negated: bool = False

    def holds(self, value: object) -> bool:
        """Whether it holds where the argument has that value."""
        return (value in self.values) is not self.negated

    def excludes(self, other: Condition) -> bool:
        """Whether never both hold."""
        if self.argument != other.argument or (self.negated and other.negated):
            return False
        if self.negated:
            return other.excludes(self)
        mine, theirs = set(self.values), set(other.values)
        return mine <= theirs if other.negated else not mine & theirs

    def among(self, choices: Sequence[Value]) -> Condition | None:
        """The condition with those of its values alone that can be chosen; None where none can.

        choices: empty for any value.
        """
        if not choices or self.negated:
            return self
        values = tuple(value for value in self.values if value in choices)
        return replace(self, values=values) if values else None

    def __str__(self) -> str:
        if self.negated and self.values == ("",):
            return f"{self.argument}:=..."
        allowed = " or ".join(_shown(value) for value in self.values)
        return f"{self.argument}:={'other than ' if self.negated else ''}{allowed}"


@dataclass(frozen=True)
class Argument:
    """What a user may set.

    default: None where the user must; choices: empty for any value; conditions: without which it
    has no effect.
    """

    name: str
    type: str
    description: str
    default: Value | None = None
    choices: tuple[str, ...] = ()
    conditions: tuple[Condition, ...] = ()

    @property
    def help(self) -> str:
        """The description, and when the argument has an effect."""
        if not self.conditions:
            return self.description
        return f"{self.description}; only with {', '.join(str(item) for item in self.conditions)}"

    @property
    def allowed(self) -> tuple[str, ...]:
        """The choices, also those of a boolean."""
        return self.choices or (("true", "false") if self.type == "boolean" else ())

    @property
    def default_text(self) -> str | None:
        """The default as a command line gives it."""
        if self.default is None:
            return None
        return _text(self.default)


def arguments_of(top: YamlSection) -> tuple[Argument, ...]:
    """The arguments that a file declares itself; DescriptionError for a wrong one."""
    section = top.optional_section("arguments")
    if section is None:
        return ()
    found, sections = [], []
    for name, _ in list(section.items()):
        item = section.section(name)
        kind = item.choice("type", tuple(ARGUMENT_TYPES))
        default = item.raw("default") if "default" in item else None
        if default is not None and not _is_a(kind, default):
            raise item.error("default", default, f"a value of type {kind}")
        choices = item.raw("choices") if "choices" in item else []
        if not isinstance(choices, list) or not all(isinstance(c, str) for c in choices):
            raise item.error("choices", choices, "a list of texts")
        found.append(Argument(name, kind, item.text("description"), default, tuple(choices)))
        sections.append(item)
    conditional = tuple(
        replace(argument, conditions=conditions_of(item, found))
        for argument, item in zip(found, sections, strict=True)
    )
    for item in sections:
        item.finish()
    return conditional


def conditions_of(section: YamlSection, declared: Sequence[Argument]) -> tuple[Condition, ...]:
    """What `when` and `unless` say: of each argument a value, or a list of them."""
    arguments = {argument.name: argument for argument in declared}
    found = []
    for key in ("when", "unless"):
        inner = section.optional_section(key) if key in section else None
        for name, raw in inner.items() if inner is not None else ():
            if name not in arguments:
                raise section.error(key, name, f"an argument: {', '.join(arguments) or 'none'}")
            values = raw if isinstance(raw, list) else [raw]
            allowed = arguments[name].choices
            if not all(fits(arguments[name], value) for value in values):
                expected = ", ".join(allowed) or f"values of type {arguments[name].type}"
                raise section.error(f"{key}.{name}", raw, expected)
            found.append(Condition(name, tuple(values), negated=key == "unless"))
    return tuple(found)


def argument_values(
    path: Path, declared: Sequence[Argument], given: Mapping[str, Value | str]
) -> dict[str, Value]:
    """The value of each declared argument; texts are converted to the argument's type.

    A pose has two more: NAME.position and NAME.orientation, three numbers each, 0 where it has no
    effect.
    Raises GraphError for a name that is not declared, a value that is missing or wrong.
    """
    names = [argument.name for argument in declared]
    for name in given:
        if name not in names:
            allowed = ", ".join(names) or "none"
            near = did_you_mean(name, names)
            msg = f"{path}: found argument {name!r}, expected one of: {allowed}{near}"
            raise GraphError(msg)
    values: dict[str, Value] = {}
    for argument in declared:
        value = given.get(argument.name, argument.default)
        if value is None:
            msg = f"{path}: argument {argument.name!r} is missing ({argument.description})"
            raise GraphError(msg)
        values[argument.name] = _convert(path, argument, value)
        if argument.type == "pose":
            numbers = _pose(path, argument, str(value))
            if not all(item.holds(values.get(item.argument)) for item in argument.conditions):
                numbers = [0.0] * 6
            for part, three in zip(POSE_PARTS, (numbers[:3], numbers[3:]), strict=True):
                values[f"{argument.name}.{part}"] = three
    return values


def check_use(path: Path, declared: Iterable[Argument], values: Mapping[str, Value]) -> None:
    """Raise GraphError for the first argument that was set though it has no effect."""
    for argument in declared:
        if argument.default is None or values[argument.name] == _convert(
            path, argument, argument.default
        ):
            continue
        for condition in argument.conditions:
            found = values[condition.argument]
            if not condition.holds(found):
                value = _shown(values[argument.name])
                msg = (
                    f"{path}: argument {argument.name}: found {value}, which has no effect with "
                    f"{condition.argument}:={_shown(found)}, expected it with {condition}"
                )
                raise GraphError(msg)


def parse_value(text: str, where: str) -> Any:
    """A value written as YAML: true, 3, 0.5, word, [1, 2]."""
    try:
        value = yaml_value(text)
    except DescriptionError:
        value = None
    single = not isinstance(value, (list, dict)) and value is not None
    if single or (isinstance(value, list) and value and len({type(v) for v in value}) == 1):
        return value
    msg = f"{where}: found {text!r}, expected a boolean, number, text or list of one kind"
    raise GraphError(msg)


def _is_a(kind: str, value: object) -> bool:
    if isinstance(value, bool):
        return kind == "boolean"
    return isinstance(value, ARGUMENT_TYPES[kind])


def fits(argument: Argument, value: object) -> bool:
    """Whether an argument of a file may have a value as it stands in one."""
    return _is_a(argument.type, value) and (not argument.choices or value in argument.choices)


def _convert(path: Path, argument: Argument, given: Value) -> Value:
    value: Any = given
    if isinstance(value, str) and not (argument.type in TEXTS or argument.type in PLACES):
        value = parse_value(value, f"{path}: argument {argument.name}")
    if not _is_a(argument.type, value):
        msg = f"{path}: argument {argument.name}: found {given!r}, expected a {argument.type}"
        raise GraphError(msg)
    if argument.choices and value not in argument.choices:
        allowed = ", ".join(argument.choices)
        msg = f"{path}: argument {argument.name}: found {given!r}, expected one of {allowed}"
        raise GraphError(msg)
    if argument.type == "number":
        return float(value)
    if argument.type in PLACES and value:
        return _place(argument.type, value)
    return value


def _place(kind: str, value: str) -> str:
    """The absolute path; a recording or scene that is not there may be a packaged one's name."""
    if kind == "recording":
        return os.pathsep.join(_place("", part) for part in value.split(os.pathsep) if part)
    place = Path(value).expanduser()
    return value if kind != "path" and not place.exists() else str(place.resolve())


def _pose(path: Path, argument: Argument, text: str) -> list[float]:
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != 6 or not all(math.isfinite(number) for number in numbers):
        expected = "six numbers, x y z in m and roll pitch yaw in rad"
        msg = f"{path}: argument {argument.name}: found {text!r}, expected {expected}"
        raise GraphError(msg)
    return numbers


def _text(value: Value) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _shown(value: Value) -> str:
    return repr(value) if value == "" else _text(value)
