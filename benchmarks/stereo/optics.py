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
from collections.abc import Iterable, Sequence
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np
from limits import CLEAN_UM, HARD_UM, PAPER_UM, LimitRun, Row, SweepPoint
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

STYLES = {
    "corners, weighted": ("#0b6e4f", "o", "-"),
    "corners, common normal": ("#1f5fbf", "s", "--"),
    "virtual, measured, weighted": ("#e08e0b", "^", "-"),
    "virtual, predicted, weighted": ("#7b3fa0", "v", ":"),
}
REFERENCES = (
    (CLEAN_UM, "limit, clean"),
    (HARD_UM, "limit, hard"),
    (PAPER_UM, "stated in the paper"),
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
        for name in STYLES:
            cells = " | ".join(f"{point.errors[name]:.2f}" for point in mine)
            lines.append(f"| {name} | {cells} |")
    path.write_text("\n".join(lines) + "\n")


def draw(points: Sequence[SweepPoint], path: Path) -> None:
    """Error over each sweep, with the limits and the paper's figure."""
    sweeps = list(dict.fromkeys(point.sweep for point in points))
    figure, axes = plt.subplots(
        1, len(sweeps), figsize=(5.6 * len(sweeps), 4.4), squeeze=False, sharey=True,
        layout="constrained",
    )  # fmt: skip
    for axis, sweep in zip(axes[0], sweeps, strict=True):
        _panel(axis, [point for point in points if point.sweep == sweep])
    axes[0, 0].set_ylabel("mean distance from the truth, µm")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False, fontsize=9)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _panel(axis: Axes, points: Sequence[SweepPoint]) -> None:
    levels = [point.level for point in points]
    for name, (color, marker, line) in STYLES.items():
        values = [point.errors[name] for point in points]
        # Hollow and wide: the two methods nearly coincide.
        hollow = {"mfc": "none", "ms": 10} if "normal" in name else {}
        axis.plot(levels, values, color=color, marker=marker, ls=line, label=name, **hollow)
    for height, text in REFERENCES:
        axis.axhline(height, color="0.6", lw=0.8)
        axis.annotate(
            f"{text}: {height:g} µm", (0.02, height), xycoords=axis.get_yaxis_transform(),
            va="bottom", fontsize=8, color="0.35",
        )  # fmt: skip
    axis.set_yscale("log")
    axis.set_yticks([0.5, 1, 2, 5, 10, 20], ["0.5", "1", "2", "5", "10", "20"])
    axis.yaxis.minorticks_off()
    axis.set_ylim(0.4, 32)
    axis.set_xlabel(f"{points[0].sweep}, {points[0].unit}")
    axis.grid(alpha=0.25)


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
