"""Tables of the arguments of the launch files, from the packaged graphs.

`setup/run python3 docs/argument_table.py docs/launch_arguments.md` renews what follows the marker
line of that file.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from cmp_tactile_bringup.graphs.description import (
    LAUNCH_ARGUMENTS,
    RUN_ARGUMENTS,
    TYPES,
    Argument,
    GraphFunction,
)
from cmp_tactile_bringup.graphs.packaged import GRAPHS
from cmp_tactile_processing.sensor.parameter_table import renew_file, with_generated_section

MARKER = "<!-- made by docs/argument_table.py from here on -->"


def as_markdown() -> str:
    """A section for each launch file, and one for what all of them take."""
    sections = [line for name, found in GRAPHS.items() for line in _section(name, found)]
    common = ["## Of all launch files\n", *_table((*RUN_ARGUMENTS, *LAUNCH_ARGUMENTS)), ""]
    return "\n".join([*sections, *common])


def _section(name: str, found: GraphFunction) -> Iterator[str]:
    summary = (found.function.__doc__ or "").strip().partition("\n")[0]
    yield f"## {name}.launch.py\n\n{summary}\n"
    arguments = found.own_arguments
    yield from _table(item for item in arguments if not item.name.startswith("right_"))
    lefts = {item.name: item.default for item in arguments if item.name.startswith("left_")}
    if lefts:
        yield "\nThose of the right finger are the same, with these defaults:\n"
        rights = (item for item in arguments if item.name.startswith("right_"))
        yield from _table(
            item for item in rights if item.default != lefts[item.name.replace("right_", "left_")]
        )
    yield ""


def _table(arguments: Iterable[Argument]) -> Iterator[str]:
    yield "| argument | default | allowed | meaning |\n|---|---|---|---|"
    for item in arguments:
        default = f"`{item.default_text}`" if item.default_text else "empty"
        allowed = ", ".join(item.allowed) or TYPES[type(item.default)]
        yield f"| `{item.name}` | {default} | {allowed} | {item.description} |"


def renew(path: Path) -> str:
    """The text of the file with its tables made again."""
    return with_generated_section(path, MARKER, as_markdown())


if __name__ == "__main__":
    renew_file(renew)
