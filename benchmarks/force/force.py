"""Force from the displacement of the markers: how exactly, how certain, how fast.

Truth comes from the simulator's contact solver on another mesh. Without options everything is
measured and written as tables (some minutes); --limits prints a row for each
limit, with --part case those of the load cases at 10 N and 1 N alone. The true cases are solved
once and kept in the cache folder.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

import numpy as np
from limits import ForceRun, Row
from threadpoolctl import threadpool_limits

from cmp_tactile_processing.sensor.description import load_sensor

TITLES = {
    "case": "Load cases at 10 N and 1 N",
    "load": "By load",
    "noise": "By noise",
    "missing": "Missing markers",
    "description": "Wrong description of the gel",
    "large press": "Neo-Hookean gel: linear against corrected",
    "certainty": "Error bars",
    "floor": "Noise alone, and small loads",
    "rendered": "End to end, from rendered frames",
    "speed": "Speed, one core",
}

NOTES = """\
Truth: contacts of rigid indenters with friction, solved by the simulator on contact nodes 0.35 mm
apart (the force nodes of the inverse: 0.69 mm) and a mesh of its own; noise 2 um in plane and 5 um
in depth. Errors are those that 95 % of the frames stay below: of Fz, of the tangential force Ft and
of the torque about the gel's origin as lengths, and L2 = |f - f_true| / |f_true| over all nodes and
components, where the true force is shared out to the nodes by the same hats. *oracle*: the least
mean L2 of a smoothing inverse that knows where the truth acts, and the best weight: what it
misses, no choice of contact nodes is likely to reach with these nodes and this noise. At 10 N edge
and ring are little better with a quarter of the noise: the spacing of the nodes limits them.
*20 N* and *50 N* are the contact of 10 N times 2 and 5, on a gel that stays linear.

How exact the truth is: with elements 0.6 as wide, and more of them in depth, the displacement
changes by 0.06 to 0.22 % (ring at 1 N: 0.45 %), at most 0.23 standard deviations of the noise, and
the Fz that is reconstructed from it by 0.04 % at most. Contact nodes 0.28 mm apart change the true
distribution, as the same indenter then touches other nodes, by 1 to 4 % (ring at 1 N: 7 %).
"""

PEERS = """\
## What others publish

Published by others, of **real sensors** with real noise, calibration and drift; ours are of
simulation alone and cannot be compared as they stand. What calibration adds to ours is the part
*wrong description of the gel*.

| | published error | range | where |
|---|---|---|---|
| iFEM, event camera | MAE 0.14 / 0.10 / 0.93 N in x / y / z | 4 / 4 / 20 N, 100 Hz | real sensor |
| 9DTact | MAE 0.30 / 0.35 / 0.28 N in x / y / z | | real sensor |
| DenseTact | 2.9 % | | real sensor |
"""


def write_markdown(rows: Sequence[Row], notes: Sequence[str], path: Path) -> None:
    """All rows, a table for each part."""
    lines = ["# Force", "", *(f"- {note}" for note in notes), "", NOTES]
    for part in dict.fromkeys(row.part for row in rows):
        lines += [f"## {TITLES[part]}", "", "| | limit | measured | met |", "|---|---|---|---|"]
        verdict = {None: "-", True: "yes", False: "**no**"}
        for row in rows:
            if row.part == part:
                cells = (row.name, row.limit, row.measured, verdict[row.met])
                lines.append("| " + " | ".join(cells) + " |")
        lines.append("")
    path.write_text("\n".join([*lines, PEERS]), encoding="utf-8")


OUTPUT = Path("benchmark_output")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    given = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    given.add_argument("--limits", action="store_true", help="print the rows, write nothing")
    given.add_argument(
        "--part",
        action="append",
        choices=ForceRun.PARTS,
        help="only this part; may be given more than once (default: all)",
    )
    given.add_argument("--frames", type=int, default=20, help="frames of noise (%(default)s)")
    given.add_argument("--sensor", default="sample_rig", help="name or file (%(default)s)")
    given.add_argument(
        "--output", type=Path, default=OUTPUT, help="folder of the tables (%(default)s)"
    )
    return given


def main() -> int:
    """Measure what the options ask for; 1 where a limit is missed."""
    arguments = parser().parse_args()
    sensor = load_sensor(arguments.sensor)
    with threadpool_limits(1):
        run = ForceRun(sensor, arguments.frames)
        began = perf_counter()
        rows = _printed(run.rows(arguments.part or ()))
    missed = sum(row.met is False for row in rows)
    print(f"{missed} limits missed, {perf_counter() - began:.0f} s")
    if not arguments.limits:
        versions = f"cmp_tactile {version('cmp_tactile_processing')}, numpy {np.__version__}"
        notes = [versions, f"sensor {sensor.name}, {arguments.frames} frames of each load"]
        arguments.output.mkdir(parents=True, exist_ok=True)
        write_markdown(rows, notes, arguments.output / "force.md")
        print(arguments.output / "force.md")
    return int(missed > 0)


def _printed(rows: Iterable[Row]) -> list[Row]:
    """The rows, each printed as it comes."""
    done = []
    print(f"{'part':11s} | {'what':44s} | {'limit':40s} | measured | met")
    for row in rows:
        verdict = {None: "-", True: "yes", False: "NO"}[row.met]
        line = f"{row.part:11s} | {row.name:44s} | {row.limit:40s} | {row.measured} | {verdict}"
        print(line, flush=True)
        done.append(row)
    return done


if __name__ == "__main__":
    sys.exit(main())
