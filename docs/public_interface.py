"""The list of all that is public: Python names, sensor file, topics, parameters, commands.

`setup/run python3 docs/public_interface.py docs/public_interface.md` renews what follows the marker
line of that file. A test compares it, and asks for a line in CHANGELOG.md with each change.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from functools import cached_property
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, get_args, get_origin, get_type_hints

import typer
import yaml
from interface_tables import NodeInterface, read_interfaces

from cmp_tactile_bringup.commands import CALIBRATIONS, IMPORTS, PROGRAM, SUBCOMMANDS, _app
from cmp_tactile_bringup.graphs.packaged import GRAPHS
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parameter_table import renew_file, with_generated_section
from cmp_tactile_processing.sensor.parts import Roi

ROOT = Path(__file__).resolve().parents[1]
MARKER = "<!-- made by docs/public_interface.py from here on -->"


def as_markdown(interfaces: list[NodeInterface]) -> str:
    """A block of plain lines for each kind of name."""
    blocks = {
        "Python": python_names(),
        "Sensor file": sensor_keys(SensorDescription),
        "Messages": messages(),
        "Nodes": nodes(interfaces),
        "Launch files": launch_files(),
        "Commands": commands(typer.main.get_command(_app([*SUBCOMMANDS, *IMPORTS, *CALIBRATIONS]))),
    }
    parts = ("\n".join((f"## {title}\n\n```text", *rows, "```")) for title, rows in blocks.items())
    return "\n\n".join(parts) + "\n"


def python_names() -> Iterator[str]:
    """Signatures of the names of docs/site/public.yaml, and of what is public in a class."""
    pages = yaml.safe_load((ROOT / "docs" / "site" / "public.yaml").read_text(encoding="utf-8"))
    for path in (path for page in pages for path in page["names"]):
        made = resolve_name(path)
        if not isinstance(made, type):
            yield f"{path}{_signature(made)}"
        elif issubclass(made, Enum):
            members = (f"{name} = {item.value!r}" for name, item in made.__members__.items())
            yield f"{path}: {', '.join(members)}"
        else:
            bases = ", ".join(base.__name__ for base in made.__bases__ if base is not object)
            yield f"{path}({bases})" if bases else path
            yield from (f"  {line}" for line in _members(made))


def _members(made: type) -> Iterator[str]:
    if is_dataclass(made):
        yield from (f"{item.name}: {item.type}{_default(item)}" for item in fields(made))
    elif not issubclass(made, Exception):
        yield f"__init__{_signature(made)}"
    for name, value in vars(made).items():
        if name.startswith("_"):
            continue
        if isinstance(value, property | cached_property):
            get = value.fget if isinstance(value, property) else value.func
            yield f"{name}: {inspect.signature(get).return_annotation}"  # type: ignore[arg-type]
        elif callable(value) or isinstance(value, classmethod | staticmethod):
            yield f"{name}{_signature(getattr(made, name))}"


def _signature(made: Any) -> str:
    text = re.sub(r"<(\w+\.\w+): [^>]*>", r"\1", str(inspect.signature(made)))
    text = re.sub(r"(: |-> )'([^']*)'", r"\1\2", text)
    return re.sub(r"\(self(, )?", "(", text)


def _default(item: Field[Any]) -> str:
    if item.default is MISSING and item.default_factory is MISSING:
        return ""
    if isinstance(item.default, Enum):
        return f" = {type(item.default).__name__}.{item.default.name}"
    is_plain = isinstance(item.default, bool | int | float | str | tuple | None)
    return f" = {item.default!r}" if is_plain else " = ..."


def sensor_keys(section: Any, above: str = "") -> Iterator[str]:
    """The keys of a sensor file by their path, with their types and defaults."""
    hints = get_type_hints(section)
    for item in (item for item in fields(section) if item.compare):
        key = above + (item.metadata.get("key") or item.name)
        kinds = (hints[item.name], *get_args(hints[item.name]))
        inner = [kind for kind in kinds if is_dataclass(kind) and kind is not Roi]
        if not inner:
            yield f"{key}: {item.type}{_default(item)}"
            continue
        several = {Mapping: ".*", tuple: "[]"}.get(get_origin(hints[item.name]), "")
        yield from sensor_keys(inner[0], f"{key}{several}.")


def messages() -> Iterator[str]:
    """The fields and constants of our messages."""
    for path in sorted((ROOT / "cmp_tactile_msgs" / "msg").glob("*.msg")):
        yield f"cmp_tactile_msgs/{path.stem}"
        lines = (line.partition("#")[0] for line in path.read_text(encoding="utf-8").splitlines())
        yield from (f"  {' '.join(line.split())}" for line in lines if line.strip())


def nodes(interfaces: list[NodeInterface]) -> Iterator[str]:
    """Topics, services and parameters of each node."""
    for node in interfaces:
        yield node.plugin or node.name
        yield from (f"  {topic.direction} {topic.name}: {topic.type}" for topic in node.topics)
        yield from (f"  service {name}: {kind}" for name, kind in node.services)
        yield from (f"  parameter {item.name} = {value!r}" for item, value in node.parameters)


def launch_files() -> Iterator[str]:
    """The arguments of the packaged graphs."""
    for name, graph in GRAPHS.items():
        arguments = (f"{item.name}:={item.default_text}" for item in graph.own_arguments)
        yield " ".join((f"{name}.launch.py", *arguments))


def commands(command: Any, words: str = PROGRAM) -> Iterator[str]:
    """The sub-commands of a command, with their arguments and options."""
    inner = getattr(command, "commands", {})
    if not inner:
        given = (item.metavar or item.name for item in command.params if item.opts[0][0] != "-")
        options = sorted({name for item in command.params for name in item.opts if name[0] == "-"})
        yield " ".join((words, *given, *options))
    for name, item in inner.items():
        yield from commands(item, f"{words} {name}")


def renew(path: Path) -> str:
    """The text of the file with its list made again."""
    return with_generated_section(path, MARKER, as_markdown(read_interfaces()))


if __name__ == "__main__":
    renew_file(renew)
