#!/usr/bin/env python3
"""Markers in 3-D: how exactly, through which optics, how fast, against OpenCV and the paper.

Frames are made by the simulator (exact truth) and, with --data or CMP_TACTILE_SAMPLE_DATA, taken
from a folder of sample frames with truth. Without options everything is measured and written as
tables (some minutes); --limits prints a row for each limit alone.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np
from limits import PAPER_UM, LimitRun, Row, SweepPoint

MARKERS = (
    "corners, weighted",
    "corners, common normal",
    "virtual, measured, weighted",
    "virtual, predicted, weighted",
)
TITLES = {
    "samples": "Sample frames of an independent renderer",
    "simulated": "Simulated frames",
    "refraction": "Distorting lens, 3 mm of plate (n 1.49) and 6 mm of gel (n 1.41)",
    "methods": "Weighted point and middle of the common normal",
    "speed": "Time",
    "gel": "Calibration by the gel, of rigs off by 1 degree, 0.5 mm and 1 % of focal length",
}
WORDS = {None: "-", True: "yes", False: "**no**"}


def write_markdown(
    rows: Sequence[Row], points: Sequence[SweepPoint], notes: Sequence[str], path: Path
) -> None:
    """A table for each part, and one for each sweep."""
    lines = ["# Optics: markers in 3-D", "", *(f"- {note}" for note in notes), ""]
    lines += [
        "Errors are mean distances from the truth, um, of all markers that were measured; the",
        f"paper states mean absolute errors below {PAPER_UM:g} um for its simulated objects.",
    ]
    for part in dict.fromkeys(row.part for row in rows):
        lines += ["", f"## {TITLES[part]}", "", "| | limit | measured | met |", "|---|---|---|---|"]
        lines += [
            f"| {row.name} | {row.limit} | {row.measured} | {WORDS[row.met]} |"
            for row in rows
            if row.part == part
        ]
    for sweep in dict.fromkeys(point.sweep for point in points):
        mine = [point for point in points if point.sweep == sweep]
        head = " | ".join(f"{point.level:g}" for point in mine)
        lines += ["", f"## Mean error, um, over {sweep}", "", f"| {mine[0].unit} | {head} |"]
        lines.append("|---" * (len(mine) + 1) + "|")
        for name in MARKERS:
            cells = " | ".join(f"{point.errors[name]:.2f}" for point in mine)
            lines.append(f"| {name} | {cells} |")
    path.write_text("\n".join(lines) + "\n")


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
        "--output", type=Path, default=OUTPUT, help="folder of the tables (%(default)s)"
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
        print(arguments.output / "optics.md")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
