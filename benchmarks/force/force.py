"""Measure the force that is computed from marker displacements: its errors and its error bars.

The true forces come from the contact solver of the simulator, on another mesh. Without options,
everything is measured and written as tables (some minutes). --limits prints a row for each limit;
with --part case, only the load cases at 10 N and 1 N. True cases are solved once and kept in the
cache folder.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

sys.path.insert(0, str(Path(__file__).parents[1]))
import numpy as np
from limits import ForceRun
from tables import CommandLine, Limit, head, line, missed
from threadpoolctl import threadpool_limits

from cmp_tactile_processing.sensor.description import load_sensor

TITLES = {
    "case": "Load cases at 10 N and 1 N",
    "load": "By load",
    "noise": "By noise",
    "smoothing": "Markers that were smoothed first",
    "missing": "Missing markers",
    "description": "Wrong description of the gel",
    "large press": "Neo-Hookean gel: linear against corrected",
    "certainty": "Error bars",
    "floor": "Noise alone, and small loads",
    "rendered": "End to end, from rendered frames",
}


def write_markdown(rows: Sequence[Limit], notes: Sequence[str], path: Path) -> None:
    """All rows, a table for each part."""
    lines = ["# Force", "", *(f"- {note}" for note in notes), "", _text("notes.md")]
    verdict = {None: "-", True: "yes", False: "**no**"}
    for table in dict.fromkeys(row.table for row in rows):
        lines += [f"## {TITLES[table]}", "", head("", "limit", "measured", "met")]
        lines += [
            line(row.name, row.limit, row.measured, verdict[row.met])
            for row in rows
            if row.table == table
        ]
        lines.append("")
    path.write_text("\n".join([*lines, _text("published.md")]), encoding="utf-8")


def _text(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def main() -> int:
    """Measure what the options ask for; 1 where a limit is missed."""
    given, parts = CommandLine(__doc__), ForceRun.PARTS
    given.option("--limits", "print a row for each limit, write no tables", False)
    given.option("--part", "only this part; repeatable", action="append", choices=parts)
    given.option("--frames", "noisy frames of each load", 20)
    given.option("--sensor", "sensor description: name or file", "sample_rig")
    given.option("--output", "folder for the tables", Path("benchmark_output"), type=Path)
    arguments = given.parse_args()
    sensor = load_sensor(arguments.sensor)
    with threadpool_limits(1):
        run = ForceRun(sensor, arguments.frames)
        began = perf_counter()
        rows = run.show(arguments.part or ())
    print(f"{perf_counter() - began:.0f} s")
    if not arguments.limits:
        versions = f"cmp_tactile {version('cmp_tactile_processing')}, numpy {np.__version__}"
        notes = [versions, f"sensor {sensor.name}, {arguments.frames} frames of each load"]
        arguments.output.mkdir(parents=True, exist_ok=True)
        write_markdown(rows, notes, arguments.output / "force.md")
        print(arguments.output / "force.md")
    return int(missed(rows) > 0)


if __name__ == "__main__":
    sys.exit(main())
