#!/usr/bin/env python3
"""Force from the displacement of the markers: how exactly, how certain, how fast.

Truth comes from the simulator's contact solver on another mesh. Without options everything is
measured and written as table, numbers and figure (some minutes); --quick prints the load cases at
10 N and 1 N alone, --limits a row for each limit. The true cases are solved once and kept in the
cache folder.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

import numpy as np
from force_cases import load_cases
from force_limits import ForceRun
from force_quick import case_lines
from force_report import draw, write_csv, write_markdown
from limit_rows import Row
from threadpoolctl import threadpool_limits

from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.library import load_sensor

OUTPUT = Path("benchmark_output")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    given = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    given.add_argument("--quick", action="store_true", help="the load cases at 10 N and 1 N")
    given.add_argument("--oracle", action="store_true", help="with --quick: what could be reached")
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
        "--output", type=Path, default=OUTPUT, help="folder of table and figure (%(default)s)"
    )
    return given


def main() -> int:
    """Measure what the options ask for; 1 where a limit is missed."""
    arguments = parser().parse_args()
    sensor = load_sensor(arguments.sensor)
    with threadpool_limits(1):
        if arguments.quick:
            return _quick(sensor, arguments.frames, arguments.oracle)
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
        write_csv(run.points, arguments.output / "force.csv")
        draw(run.points, arguments.output / "force.png")
        print(f"{arguments.output / 'force.md'}, .csv and .png")
    return int(missed > 0)


def _quick(sensor: SensorDescription, frames: int, oracle: bool) -> int:
    began = perf_counter()
    model, cases = ForceModel(sensor), load_cases(sensor)
    print(f"model and cases ready in {perf_counter() - began:.1f} s")
    missed = 0
    for line in case_lines(model, cases, frames, oracle):
        missed += "MISS" in line
        print(line, flush=True)
    print(f"{missed} cases miss a limit, {perf_counter() - began:.0f} s")
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
