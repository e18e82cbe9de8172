"""Tables of the sub-commands and exit codes of `cmp_tactile`, from the program.

`setup/run python3 docs/command_table.py cmp_tactile_bringup/README.md` renews what is between the
marker line of that file and its next heading.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from cmp_tactile_bringup.commands import CALIBRATIONS, EXIT_CODES, IMPORTS, SUBCOMMANDS
from cmp_tactile_processing.sensor.parameter_table import renew_file, with_generated_section

MARKER = "<!-- made by docs/command_table.py up to the next heading -->"
# The page that explains each sub-command, from the folder of the README.
PAGES = {
    "demo": "#demo",
    "live": "../docs/launch.md",
    "sensor": "../docs/launch.md",
    "gripper": "../docs/gripper.md",
    "simulate": "../docs/tutorials/simulate.md",
    "dataset": "../docs/tutorials/dataset.md",
    "grasp": "../docs/grasp.md",
    "process": "#process",
    "export": "../docs/datasets.md",
    "zero": "../docs/reference.md",
    "call": "../docs/nodes.md",
    "topics": "../docs/launch.md",
    "echo": "../docs/launch.md",
    "record": "../docs/recordings.md",
    "replay": "../docs/recordings.md",
    "view": "../docs/viewer.md",
    "focus": "../docs/camera.md",
    "init": "../docs/tutorials/webcam.md",
    "pattern": "../docs/print.md",
    "schema": "../docs/sensor_description.md",
    "info": "../docs/sensor_description.md",
    "import": "../docs/other_sensors.md",
    "calibrate": "#calibrate",
}


def as_markdown() -> str:
    """Both tables."""
    lines = [
        "| command | does |",
        "|---|---|",
        *(f"| [`cmp_tactile {name}`]({page}) | {summary} |" for name, page, summary in _commands()),
        "",
        "| exit code | means |",
        "|---|---|",
        *(f"| {number} | {meaning} |" for number, meaning in EXIT_CODES.items()),
    ]
    return "\n".join(lines)


def _commands() -> Iterator[tuple[str, str, str]]:
    """Name, page and summary of each sub-command."""
    groups = {"import": IMPORTS, "calibrate": CALIBRATIONS}
    listed = {**{name: {"": found} for name, found in SUBCOMMANDS.items()}, **groups}
    for name, subcommands in listed.items():
        for second, (_, summary) in subcommands.items():
            yield f"{name} {second}".strip(), PAGES[name], summary


def renew(path: Path) -> str:
    """The text of the file with its tables made again."""
    _, _, old = path.read_text(encoding="utf-8").partition(MARKER)
    _, heading, rest = old.partition("\n#")
    return with_generated_section(path, MARKER, f"{as_markdown()}\n{heading}{rest}")


if __name__ == "__main__":
    renew_file(renew)
