"""Draws docs/images/grip.png of two recordings of the tutorial, with and without reaction to slip.

`setup/run python3 docs/drawings/grip.py held lost docs/images/grip.png`
"""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cmp_tactile_driver.bags.storage import BagStorage
from cmp_tactile_processing.measured import SlipState

mpl.use("agg")
from matplotlib import pyplot as plt
from matplotlib.ticker import MultipleLocator

FRICTION = 0.4  # of the grasp flask
LIFTED_M = 0.021  # height of the flask's middle, just above the table
BLUE, ORANGE, MAGENTA, GREY = "#0072b2", "#d55e00", "#cc3399", "#888888"
COLOURS = 32

Rows = NDArray[np.float64]


def rows(bag: Path, topic: str, values: Any) -> Rows:
    """Stamps and what `values` takes of each message of a topic, (n, 1 + k)."""
    found = []
    for message in BagStorage(bag).decoded([topic]):
        stamp = message.header.stamp
        found.append([stamp.sec + 1e-9 * stamp.nanosec, *values(message)])
    return np.array(found)


def recorded(bag: Path) -> tuple[Rows, Rows, Rows]:
    """Measured normal force and slip state; true forces; heights; time from the lift on, s."""
    felt = rows(
        bag, "/left_finger/force_field", lambda item: (-item.wrench.force.z, item.slip_state)
    )
    true = rows(
        bag,
        "/left_finger/truth/wrench",
        lambda item: (-item.wrench.force.z, np.hypot(item.wrench.force.x, item.wrench.force.y)),
    )
    place = rows(bag, "/object/pose", lambda item: (item.pose.position.z,))
    begin = place[np.argmax(place[:, 1] > LIFTED_M), 0]
    for table in (felt, true, place):
        table[:, 0] -= begin
    return felt, true, place


def draw_force(axes: Any, felt: Rows, true: Rows) -> None:
    """Measured and true normal force, and where slip was reported."""
    axes.plot(*true[:, :2].T, color="black", lw=1.2, label="true")
    axes.plot(*felt[:, :2].T, color=ORANGE, lw=1.6, label="measured")
    least = true[:, 2] / FRICTION
    axes.plot(true[:, 0], least, color=GREY, lw=1.2, ls=":", label="least that holds the flask")
    slips = felt[felt[:, 2] >= SlipState.INCIPIENT]
    axes.plot(*slips[:, :2].T, "o", ms=4, color=MAGENTA, label="slip is reported")


def draw_friction(axes: Any, true: Rows, place: Rows) -> None:
    """Share of the friction that is used, and how high the flask is."""
    with np.errstate(divide="ignore", invalid="ignore"):
        axes.plot(true[:, 0], true[:, 2] / true[:, 1], color="black", lw=1.2)
    axes.axhline(FRICTION, color=GREY, lw=1, ls=":")
    axes.annotate(
        "friction", (0.01, FRICTION), xycoords=("axes fraction", "data"), va="bottom", color=GREY
    )
    axes.set_ylim(0, 0.48)
    axes.set_xlabel("time since the flask is lifted, s")
    height = axes.twinx()
    height.plot(place[:, 0], 100 * place[:, 1], color=BLUE, lw=1.2)
    height.set_ylim(0, 7)
    height.set_ylabel("height, cm", color=BLUE)
    height.spines["top"].set_visible(False)


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
        felt, true, place = recorded(path)
        draw_force(column[0], felt, true)
        draw_friction(column[1], true, place)
        column[0].set_title(title, loc="left", weight="bold")
        for axes in column:
            # Without the reaction, the simulation begins again.
            axes.set_xlim(-1, 14)
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
