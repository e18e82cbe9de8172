"""Force from the displacement of the markers: how exactly, how certain, how fast.

Truth comes from the simulator's contact solver on another mesh. Without options everything is
measured and written as table, numbers and figure (some minutes); --limits prints a row for each
limit, with --part case those of the load cases at 10 N and 1 N alone. The true cases are solved
once and kept in the cache folder.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

import numpy as np
from cases import LINEAR, SCALED_N, SOLVED_N
from errors import FORCE_N, FORCE_SHARE, L2_LIMITS
from limits import JUDGED_DEPTH, LARGE_PRESS_SHARE, ForceRun, Row
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from sweeps import Point
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


def write_csv(points: Sequence[Point], path: Path) -> None:
    """A line for each load under each condition; N, N m, shares."""
    names = ("fz", "ft", "torque", "l2", "area")
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        columns = [f"{name}_{kind}" for name in names for kind in ("mean", "high")]
        table.writerow(["sweep", "condition", "case", "newton", *columns, "contacts", "oracle_l2"])
        for point in points:
            errors = point.errors
            values = [
                value
                for name in names
                for value in (float(np.mean(getattr(errors, name))), errors.high(name))
            ]
            table.writerow(
                [point.sweep, point.condition, point.case.name, f"{point.case.newton:.4g}"]
                + [f"{value:.4g}" for value in values]
                + [f"{np.mean(errors.contacts):.3g}", f"{point.oracle:.4g}"]
            )


def draw(points: Sequence[Point], path: Path) -> None:
    """Six panels."""
    figure, axes = plt.subplots(2, 3, figsize=(15, 8.5), layout="constrained")
    panels: tuple[Callable[[Axes, Sequence[Point]], None], ...] = (
        _draw_cases, _draw_loads, _draw_noise, _draw_missing, _draw_descriptions, _draw_depths,
    )  # fmt: skip
    for panel, ax in zip(panels, axes.ravel(), strict=True):
        panel(ax, points)
        ax.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_cases(ax: Axes, points: Sequence[Point]) -> None:
    chosen = [point for point in points if point.sweep == "case" and point.condition == LINEAR]
    names = list(dict.fromkeys(point.case.name for point in chosen))
    for offset, newton, colour in ((-0.2, 10.0, "tab:blue"), (0.2, 1.0, "tab:orange")):
        some = {point.case.name: point for point in chosen if point.case.newton == newton}
        place = np.arange(len(some)) + offset
        ax.bar(place, [100 * some[name].errors.high("l2") for name in some], 0.38,
               color=colour, label=f"{newton:g} N")  # fmt: skip
        best = [100 * point.oracle for point in some.values()]
        ax.plot(place, best, "k_", markersize=12, label="oracle" if newton == 1 else None)
        ax.axhline(100 * L2_LIMITS[newton], color=colour, linestyle="--", linewidth=1)
    ax.set_xticks(range(len(names)), names, rotation=30, ha="right")
    ax.set(title="Distribution, by load case (dashed: limits)", ylabel="relative L2 error, %")
    ax.legend()


def _draw_loads(ax: Axes, points: Sequence[Point]) -> None:
    chosen = [point for point in points if point.sweep == "load"]
    for name in dict.fromkeys(point.case.name for point in chosen):
        some = [point for point in chosen if point.case.name == name]
        loads = [point.case.newton for point in some]
        ax.loglog(loads, [point.errors.high("fz") for point in some], "o-", label=name)
    newton = np.array([*SOLVED_N, *SCALED_N])
    ax.loglog(newton, FORCE_SHARE * newton + FORCE_N, "k--", label="limit")
    ax.set_xticks(newton, [f"{load:g}" for load in newton])
    ax.minorticks_off()
    ax.set(title="Normal force, by load", xlabel="N", ylabel="error of 95 % of frames, N")
    ax.legend(fontsize=7, ncols=2)


def _draw_noise(ax: Axes, points: Sequence[Point]) -> None:
    chosen = [point for point in points if point.sweep == "noise"]
    for name in dict.fromkeys(point.case.name for point in chosen):
        for newton, style in ((10.0, "o-"), (1.0, "s:")):
            some = [p for p in chosen if p.case.name == name and p.case.newton == newton]
            levels = [point.level for point in some]
            values = [100 * point.errors.high("l2") for point in some]
            ax.semilogx(levels, values, style, label=f"{name}, {newton:g} N")
    ticks = sorted({point.level for point in chosen})
    ax.set_xticks(ticks, [f"{level:g}" for level in ticks], minor=False)
    ax.minorticks_off()
    ax.set(title="Distribution, by noise", xlabel="times 2 um in plane, 5 um in depth",
           ylabel="relative L2 error, %")  # fmt: skip
    ax.legend(fontsize=7, ncols=2)


def _draw_missing(ax: Axes, points: Sequence[Point]) -> None:
    chosen = [p for p in points if p.sweep == "missing" and p.case.newton == 10.0]
    _draw_bars(ax, chosen, lambda point: 100 * point.errors.high("fz") / point.case.newton)
    ax.set(title="Missing markers, 10 N", ylabel="error of Fz, %")


def _draw_descriptions(ax: Axes, points: Sequence[Point]) -> None:
    chosen = [point for point in points if point.sweep == "description"]
    _draw_bars(ax, chosen, lambda point: 100 * float(np.mean(point.errors.fz)) / point.case.newton)
    ax.set(title="Wrong description of the gel, 10 N", ylabel="error of Fz, %")


def _draw_bars(ax: Axes, points: Sequence[Point], value: Callable[[Point], float]) -> None:
    conditions = list(dict.fromkeys(point.condition for point in points))
    names = list(dict.fromkeys(point.case.name for point in points))
    for index, name in enumerate(names):
        some = [value(point) for point in points if point.case.name == name]
        place = np.arange(len(some)) + (index - len(names) / 2 + 0.5) * 0.8 / len(names)
        ax.bar(place, some, 0.8 / len(names), label=name)
    ax.set_xticks(range(len(conditions)), conditions, rotation=30, ha="right")
    if names:
        ax.legend(fontsize=8)


def _draw_depths(ax: Axes, points: Sequence[Point]) -> None:
    chosen = [point for point in points if point.sweep == "large press"]
    for name in dict.fromkeys(point.case.name for point in chosen):
        for condition, style in (("linear", "o:"), ("corrected", "s-")):
            some = [p for p in chosen if p.case.name == name and p.condition == condition]
            depth = [1e3 * point.case.depth for point in some]
            share = [100 * float(np.mean(p.errors.fz)) / p.case.newton for p in some]
            if some:
                ax.plot(depth, share, style, label=f"{name}, {condition}")
    for sign in (-1, 1):
        ax.axhline(sign * 100 * LARGE_PRESS_SHARE, color="k", linestyle="--", linewidth=1)
    ax.axvline(1e3 * JUDGED_DEPTH, color="k", linestyle=":", linewidth=1)
    ax.set(title="Neo-Hookean gel", xlabel="depth of the indenter, mm", ylabel="error of Fz, %")
    if chosen:
        ax.legend(fontsize=7, ncols=2)


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
        "--output", type=Path, default=OUTPUT, help="folder of table and figure (%(default)s)"
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
        write_csv(run.points, arguments.output / "force.csv")
        draw(run.points, arguments.output / "force.png")
        print(f"{arguments.output / 'force.md'}, .csv and .png")
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
