"""Tables of the arguments of the launch files, from the packaged graph files.

`python3 -m cmp_tactile_bringup.graphs.launch_table docs/launch.md` renews
what follows the marker line of that file.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from cmp_tactile_bringup.graphs.arguments import Argument
from cmp_tactile_bringup.graphs.description import read_arguments
from cmp_tactile_bringup.graphs.run_arguments import RUN_ARGUMENTS, RVIZ
from cmp_tactile_bringup.graphs.shared_files import find_config
from cmp_tactile_processing.sensor.parameter_table import with_generated_section

__all__ = ["GRAPHS", "MARKER", "as_markdown", "renew"]

MARKER = "<!-- made by cmp_tactile_bringup.graphs.launch_table from here on -->"
GRAPHS = ("sensor", "simulate", "replay", "gripper")
# The arguments of the right finger are those of the left one, with other defaults.
LEFT, RIGHT = "left_", "right_"


def as_markdown() -> str:
    """The tables, one section a launch file."""
    sections = [line for graph in GRAPHS for line in _section(graph)]
    common = ["## Of all launch files\n", *_rows((*RUN_ARGUMENTS, RVIZ)), ""]
    return "\n".join([*sections, *common])


def renew(path: Path) -> str:
    """The text of the file with the tables after the marker line made anew.

    Raises ValueError where the file has no such line.
    """
    return with_generated_section(path, MARKER, as_markdown())


def _section(graph: str) -> Iterator[str]:
    path = find_config(graph)
    yield f"## {graph}.launch.py\n"
    yield f"{_summary(path)}\n"
    arguments = read_arguments(path)
    yield from _rows(item for item in arguments if not item.name.startswith(RIGHT))
    others = [item for item in arguments if item.name.startswith(RIGHT)]
    if others:
        lefts = {item.name.removeprefix(LEFT): item.default for item in arguments}
        yield ""
        yield "Those of the right finger are the same, with these defaults:\n"
        yield from _rows(
            item for item in others if item.default != lefts[item.name.removeprefix(RIGHT)]
        )
    yield ""


def _summary(path: Path) -> str:
    """What the first comment of a graph file says after its name, to its first full stop."""
    lines = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        lines.append(line.removeprefix("# "))
    text = " ".join(" ".join(lines).partition(": ")[2].split())
    return f"{text[0].upper()}{text[1:].partition('.')[0]}."


def _rows(arguments: Iterable[Argument]) -> Iterator[str]:
    yield "| argument | default | allowed | meaning |\n|---|---|---|---|"
    for item in arguments:
        if item.default_text is None:
            default = "must be given"
        else:
            default = f"`{item.default_text}`" if item.default_text else "empty"
        kind = {"boolean": "", "recording": "path or scene", "scene": "path or scene"}
        allowed = ", ".join(item.allowed) or kind.get(item.type, item.type)
        yield f"| `{item.name}` | {default} | {allowed} | {item.help} |"


if __name__ == "__main__":
    target = Path(sys.argv[1])
    target.write_text(renew(target), encoding="utf-8")
