"""Tables and plots of the sweeps."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

import matplotlib as mpl
import numpy as np
from extraction_sweeps import Point

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

STYLES = {
    "cmp_tactile": ("#0b6e4f", "o", "-"),
    "cmp_tactile, following": ("#0b6e4f", "D", ":"),
    "contour stitching": ("#e08e0b", "^", "--"),
    "OpenCV classic + cornerSubPix": ("#1f5fbf", "s", "-"),
    "OpenCV sector based (SB)": ("#7b3fa0", "v", "-"),
    "mrgingham (command)": ("#8a8a8a", "P", "-"),
    "cornerSubPix from the last frame": ("#c0392b", "x", ":"),
}
METRICS = (
    ("success", "views complete, none wrong", False),
    ("error", "RMSE of corners, px", True),
    ("ms", "ms a view", True),
)
LEAST_VALUE = 1e-3
APART = 0.012


def write_csv(points: Sequence[Point], path: Path) -> None:
    """All points, a line each."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Point)])
        writer.writeheader()
        for point in points:
            rounded = {
                key: f"{value:.5g}" if isinstance(value, float) else value
                for key, value in asdict(point).items()
            }
            writer.writerow(rounded)


def write_markdown(points: Sequence[Point], versions: Sequence[str], path: Path) -> None:
    """A table for each sweep: per detector and level, complete views, RMSE and time."""
    lines = ["# Gridline extraction", "", *(f"- {version}" for version in versions)]
    lines += [
        "",
        "Each entry: views with every visible corner found and none wrong; RMSE of the corners",
        "that were found, px (of their displacement, where prints are flawed); median time of the",
        "processor for a view, ms. `w`: number of corners with wrong numbers.",
    ]
    lines += ["", "## How far each gets", ""]
    lines += [
        "The hardest level up to which every view was complete; `+` where time was up then.",
        "",
    ]
    lines += _summary(points)
    for sweep in dict.fromkeys(point.sweep for point in points):
        mine = [point for point in points if point.sweep == sweep]
        levels = list(dict.fromkeys(point.level for point in mine))
        lines += ["", f"## {sweep.capitalize()}", ""]
        lines.append(f"| {mine[0].axis} | " + " | ".join(f"{level:.3g}" for level in levels) + " |")
        lines.append("|---" * (len(levels) + 1) + "|")
        for detector in dict.fromkeys(point.detector for point in mine):
            by_level = {point.level: point for point in mine if point.detector == detector}
            cells = [_cell(by_level.get(level)) for level in levels]
            lines.append(f"| {detector} | " + " | ".join(cells) + " |")
    path.write_text("\n".join(lines) + "\n")


def _summary(points: Sequence[Point]) -> list[str]:
    """The hardest level up to which all views of all levels were complete, per sweep."""
    detectors = list(dict.fromkeys(point.detector for point in points))
    lines = ["| | " + " | ".join(detectors) + " |", "|---" * (len(detectors) + 1) + "|"]
    for sweep in dict.fromkeys(point.sweep for point in points):
        mine = [point for point in points if point.sweep == sweep]
        hardest = mine[-1].level
        reached = [
            _reached([point for point in mine if point.detector == detector], hardest)
            for detector in detectors
        ]
        lines.append(f"| {sweep}: {mine[0].axis} | " + " | ".join(reached) + " |")
    return lines


def _reached(points: Sequence[Point], hardest: float) -> str:
    """The last level before the first failure; with + where none failed but not all were run."""
    if not points:
        return "-"
    failed = next((k for k, point in enumerate(points) if point.success < 1), len(points))
    if failed == 0:
        return "none"
    more = "+" if failed == len(points) and points[-1].level != hardest else ""
    return f"{points[failed - 1].level:.3g}{more}"


def _cell(point: Point | None) -> str:
    if point is None:
        return "-"
    wrong = f", {point.wrong} w" if point.wrong else ""
    error = "" if np.isnan(point.error) else f", {point.error:.3f}"
    return f"{100 * point.success:.0f} %{error}, {point.ms:.1f}{wrong}"


def draw(points: Sequence[Point], path: Path) -> None:
    """One figure: a row for each sweep, with success, error and time."""
    sweeps = list(dict.fromkeys(point.sweep for point in points))
    figure, axes = plt.subplots(
        len(sweeps), 3, figsize=(13, 2.6 * len(sweeps) + 0.9), squeeze=False, layout="constrained"
    )
    for row, sweep in zip(axes, sweeps, strict=True):
        mine = [point for point in points if point.sweep == sweep]
        for axis, (metric, title, logarithmic) in zip(row, METRICS, strict=True):
            _panel(axis, mine, metric)
            axis.set_xlabel(f"{sweep}: {mine[0].axis}")
            axis.set_ylabel(title)
            axis.grid(alpha=0.25)
            if logarithmic:
                axis.set_yscale("log")
                axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
                axis.yaxis.set_major_formatter("{x:g}")
                axis.yaxis.set_minor_formatter(NullFormatter())
            else:
                axis.set_ylim(-0.1, 1.05)
    shown = {point.detector for point in points}
    handles = [
        Line2D([], [], color=color, marker=marker, linestyle=line, label=name)
        for name, (color, marker, line) in STYLES.items()
        if name in shown
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=4, frameon=False)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _panel(axis: Axes, points: Sequence[Point], metric: str) -> None:
    levels = list(dict.fromkeys(point.level for point in points))
    for detector in dict.fromkeys(point.detector for point in points):
        color, marker, line = STYLES.get(detector, ("black", ".", "-"))
        mine = [point for point in points if point.detector == detector]
        values = [max(getattr(point, metric), LEAST_VALUE) for point in mine]
        if metric == "success":
            # A little apart: many lie at 1.
            values = [point.success - APART * list(STYLES).index(detector) for point in mine]
        # Levels are a step each: they are not evenly spaced.
        places = [levels.index(point.level) for point in mine]
        axis.plot(places, values, color=color, marker=marker, linestyle=line, ms=5, lw=1.4)
    axis.set_xticks(range(len(levels)), [f"{level:.3g}" for level in levels])
