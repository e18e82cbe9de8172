#!/usr/bin/env python3
"""Markers in 3-D: how exactly, through which optics, how fast, against OpenCV and the paper.

Frames are made by the simulator (exact truth) and, with --data or CMP_TACTILE_SAMPLE_DATA, taken
from a folder of sample frames with truth. Without options everything is measured and written as
table and figure (some minutes); --limits prints a row for each limit alone.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np
from limit_rows import Row
from optics_limits import LimitRun
from optics_report import draw, write_markdown

OUTPUT = Path("benchmark_output")
DATA_VARIABLE = "CMP_TACTILE_SAMPLE_DATA"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    given = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    given.add_argument("--quick", action="store_true", help="fewer frames of each kind")
    given.add_argument("--limits", action="store_true", help="print the limits, write nothing")
    given.add_argument(
        "--part",
        action="append",
        choices=LimitRun.PARTS,
        help="only this part; may be given more than once (default: all)",
    )
    given.add_argument(
        "--data",
        type=Path,
        default=os.environ.get(DATA_VARIABLE),
        help=f"folder of sample frames (default: ${DATA_VARIABLE})",
    )
    given.add_argument(
        "--output", type=Path, default=OUTPUT, help="folder of table and figure (%(default)s)"
    )
    return given


def printed(rows: Iterable[Row]) -> list[Row]:
    """The rows, each printed as it comes."""
    done = []
    print(f"{'what':62s} | {'limit':14s} | {'measured':58s} | met")
    for row in rows:
        verdict = {None: "-", True: "yes", False: "NO"}[row.met]
        print(f"{row.name:62s} | {row.limit:14s} | {row.measured:58s} | {verdict}", flush=True)
        done.append(row)
    return done


def main() -> int:
    """Measure what the options ask for; 1 where a limit is missed."""
    arguments = parser().parse_args()
    run = LimitRun(Path(arguments.data) if arguments.data else None, arguments.quick)
    began = perf_counter()
    rows = printed(run.rows(arguments.part or ()))
    missed = sum(row.met is False for row in rows)
    print(f"{missed} limits missed, {perf_counter() - began:.0f} s")
    if not arguments.limits:
        points = list(run.sweep_points())
        versions = f"OpenCV {cv2.__version__}, numpy {np.__version__}"
        where = "with" if run.samples else "without"
        notes = [versions, f"{where} sample frames{', quick' if run.quick else ''}"]
        arguments.output.mkdir(parents=True, exist_ok=True)
        write_markdown(rows, points, notes, arguments.output / "optics.md")
        draw(points, arguments.output / "optics.png")
        print(f"{arguments.output / 'optics.md'}, {arguments.output / 'optics.png'}")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
