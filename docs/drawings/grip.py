"""Draws docs/images/grip.png of what docs/examples/cup.py wrote down, with and without reaction.

`setup/run python3 docs/drawings/grip.py held.csv lost.csv docs/images/grip.png`
"""

from __future__ import annotations

import csv
import io
import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image

mpl.use("agg")
from matplotlib import pyplot as plt
from matplotlib.ticker import MultipleLocator

FRICTION = 0.4  # of the scene ball:16mm
BLUE, ORANGE, MAGENTA, GREY = "#0072b2", "#d55e00", "#cc3399", "#888888"
COLOURS = 32

Table = dict[str, NDArray[Any]]


def read(path: Path) -> Table:
    """The columns of a table; times count from when the cup is lifted."""
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    words = [row.pop("state") for row in rows]
    table = {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}
    lifted = table["time"][np.argmax(table["asked"] > 0)]
    return {**table, "time": table["time"] - lifted, "state": np.array(words)}


def draw_force(axes: Any, table: Table) -> None:
    """Target, measured and true normal force, and where slip was reported."""
    time = table["time"]
    axes.plot(time, table["target"], color=BLUE, lw=1.2, ls="--", label="target")
    axes.plot(time, table["true_normal"], color="black", lw=1.2, label="true")
    axes.plot(time, table["felt_normal"], color=ORANGE, lw=1.6, label="measured")
    axes.plot(
        time,
        table["asked"] / FRICTION,
        color=GREY,
        lw=1.2,
        ls=":",
        label="least that holds the cup",
    )
    slips = table["slip_state"] >= 3
    axes.plot(
        time[slips], table["felt_normal"][slips], "o", ms=4, color=MAGENTA, label="slip is reported"
    )
    close = np.char.endswith(table["state"], "close to slip") & ~slips
    axes.plot(
        time[close], table["felt_normal"][close], ".", ms=4, color=BLUE, label="close to the limit"
    )


def draw_friction(axes: Any, table: Table) -> None:
    """Share of the friction that is used, and how far the cup slid."""
    with np.errstate(divide="ignore", invalid="ignore"):
        used = table["true_tangential"] / table["true_normal"]
    axes.plot(table["time"], used, color="black", lw=1.2)
    axes.axhline(FRICTION, color=GREY, lw=1, ls=":")
    axes.annotate(
        "friction", (0.01, FRICTION), xycoords=("axes fraction", "data"), va="bottom", color=GREY
    )
    axes.set_ylim(0, 0.48)
    axes.set_xlabel("time since the cup is lifted, s")


def main(held: Path, lost: Path, picture: Path) -> None:
    """Both runs beside one another."""
    figure, grid = plt.subplots(
        2,
        2,
        sharex="col",
        sharey="row",
        figsize=(10, 5.6),
        layout="constrained",
        height_ratios=[2, 1],
    )
    titles = ("With the reaction to slip", "Without (boost:=1.0)")
    for column, path, title in zip(grid.T, (held, lost), titles, strict=True):
        table = read(path)
        draw_force(column[0], table)
        draw_friction(column[1], table)
        column[0].set_title(title, loc="left", weight="bold")
        for axes in column:
            axes.set_xlim(-4, None)
            axes.xaxis.set_major_locator(MultipleLocator(2))
            axes.spines[["top", "right"]].set_visible(False)
    grid[0, 0].set_ylabel("normal force, N")
    grid[1, 0].set_ylabel("tangential / normal")
    grid[0, 0].legend(loc="upper left", frameon=False, fontsize=9)
    kept = io.BytesIO()
    figure.savefig(kept, dpi=100)
    Image.open(kept).convert("RGB").quantize(COLOURS).save(picture, optimize=True)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
