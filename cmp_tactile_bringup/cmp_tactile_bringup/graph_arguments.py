"""Arguments of a graph file: what a user may set when the graph is started."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from cmp_tactile_bringup.errors import GraphError
from cmp_tactile_processing.yaml_section import YamlSection

__all__ = ["ARGUMENT_TYPES", "Argument", "Value", "argument_values", "arguments_of", "parse_value"]

ARGUMENT_TYPES: dict[str, type | tuple[type, ...]] = {
    "text": str,
    "path": str,
    "recording": str,
    "scene": str,
    "number": (int, float),
    "integer": int,
    "boolean": bool,
}
# recording, scene: a path, or the name of a packaged scene.
PLACES = ("path", "recording", "scene")

Value = bool | int | float | str | list[bool] | list[int] | list[float] | list[str]


@dataclass(frozen=True)
class Argument:
    """What a user may set.  default: None where the user must; choices: empty for any value."""

    name: str
    type: str
    description: str
    default: Value | None = None
    choices: tuple[str, ...] = ()


def arguments_of(top: YamlSection) -> tuple[Argument, ...]:
    """The arguments that a graph file declares; DescriptionError for a wrong one."""
    section = top.optional_section("arguments")
    if section is None:
        return ()
    found = []
    for name, _ in list(section.items()):
        item = section.section(name)
        kind = item.choice("type", tuple(ARGUMENT_TYPES))
        default = item.raw("default") if "default" in item else None
        if default is not None and not _is_a(kind, default):
            raise item.error("default", default, f"a value of type {kind}")
        choices = item.raw("choices") if "choices" in item else []
        if not isinstance(choices, list) or not all(isinstance(c, str) for c in choices):
            raise item.error("choices", choices, "a list of texts")
        description = item.text("description")
        item.finish()
        found.append(Argument(name, kind, description, default, tuple(choices)))
    return tuple(found)


def argument_values(
    path: Path, declared: Sequence[Argument], given: Mapping[str, Value | str]
) -> dict[str, Value]:
    """The value of each declared argument; texts are converted to the argument's type.

    Raises GraphError for a name that is not declared, a value that is missing or wrong.
    """
    names = [argument.name for argument in declared]
    for name in given:
        if name not in names:
            allowed = ", ".join(names) or "none"
            msg = f"{path}: found argument {name!r}, expected one of: {allowed}"
            raise GraphError(msg)
    values: dict[str, Value] = {}
    for argument in declared:
        value = given.get(argument.name, argument.default)
        if value is None:
            msg = f"{path}: argument {argument.name!r} is missing ({argument.description})"
            raise GraphError(msg)
        values[argument.name] = _convert(path, argument, value)
    return values


def parse_value(text: str, where: str) -> Any:
    """A value written as YAML: true, 3, 0.5, word, [1, 2]."""
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
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


def _convert(path: Path, argument: Argument, given: Value) -> Value:
    value: Any = given
    if isinstance(value, str) and argument.type not in ("text", "path"):
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
    place = Path(value).expanduser()
    return value if kind != "path" and not place.exists() else str(place.resolve())
