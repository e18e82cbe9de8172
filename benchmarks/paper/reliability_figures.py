"""Pictures of section IV.F: success over the levels, and what the frames look like."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from paper import figure_style
from paper.disturbances import SWEEPS, Sweep
from paper.dot_methods import ALL_METHODS
from paper.experiment import Results
from paper.failure_levels import Endurance

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_curves", "draw_strips", "level_text"]

ROW_HEIGHT_IN = 1.9
LARGEST_MARKER, SMALLER_BY = 9.0, 1.4


def level_text(sweep: Sweep, level: float) -> str:
    """A level as a reader takes it."""
    return f"{level:.0%}".replace("%", " %") if sweep.percent else f"{level:.2g}"


def draw_curves(
    endurances: Mapping[tuple[str, str], Endurance], keys: Sequence[str], path: Path
) -> Path:
    """Success, markers found and error over the levels of some sweeps, of every method."""
    import matplotlib.pyplot as plt

    figure_style.apply()
    size = figure_style.WIDTH_IN, 3 * ROW_HEIGHT_IN + 0.5
    figure, axes = plt.subplots(3, len(keys), figsize=size, sharex="col", squeeze=False)
    for column, key in zip(axes.T, keys, strict=True):
        sweep = SWEEPS[key]
        for number, method in enumerate(ALL_METHODS):
            endurance = endurances[key, method.key]
            rows = 100 * endurance.success, 100 * endurance.found, 1e6 * endurance.error
            for axis, values in zip(column, rows, strict=True):
                axis.plot(
                    endurance.levels,
                    values,
                    figure_style.LINES[method.key],
                    color=figure_style.COLOURS[method.key],
                    marker=figure_style.MARKERS[method.key],
                    # One on the other, all are to be seen.
                    markersize=LARGEST_MARKER - SMALLER_BY * number,
                    fillstyle="none",
                    label=method.label,
                )
        _level_axis(column, sweep)
    for axis, name in zip(
        axes[:, 0], ("frames without fault, %", "markers found, %"), strict=False
    ):
        axis.set_ylabel(name)
    axes[2, 0].set_ylabel("median error of\ndisplacement, um")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure_style.save(figure, path)


def _level_axis(column: Sequence[Axes], sweep: Sweep) -> None:
    from matplotlib.ticker import LogLocator

    top, middle, bottom = column
    top.set_title(sweep.title)
    for axis in (top, middle):
        axis.set_ylim(-4, 104)
    bottom.set_yscale("log")
    # Plain numbers: powers of ten would need fonts for formulas.
    bottom.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    bottom.yaxis.set_major_formatter(_plain)
    bottom.yaxis.set_minor_formatter(_nothing)
    if sweep.logarithmic:
        bottom.set_xscale("log")
        bottom.xaxis.set_minor_formatter(_nothing)
    if sweep.levels[0] > sweep.levels[-1]:
        bottom.invert_xaxis()
    bottom.xaxis.set_major_formatter(_in_percent if sweep.percent else _plain)
    bottom.set_xlabel(sweep.level + (", %" if sweep.percent else ""))
    if sweep.paper_limit is not None:
        for axis in column:
            axis.axvline(sweep.paper_limit, color=figure_style.PAPER_COLOUR, linestyle="--")
        middle.annotate(
            "paper's limit",
            (sweep.paper_limit, 40),
            xytext=(4, 0),
            textcoords="offset points",
            color=figure_style.PAPER_COLOUR,
        )


def _plain(value: float, position: float = 0) -> str:
    del position
    return f"{value:g}"


def _in_percent(value: float, position: float = 0) -> str:
    return _plain(round(100 * value, 6), position)


def _nothing(value: float, position: float = 0) -> str:
    del value, position
    return ""


def draw_strips(
    results: Results, cmp: Mapping[str, Endurance], keys: Sequence[str], path: Path
) -> Path:
    """What both prints look like from level to level.  cmp: how CMP fares, by sweep."""
    import matplotlib.pyplot as plt

    figure_style.apply()
    prints = ("cmp", "dmp")
    shown = {key: _shown_levels(SWEEPS[key], cmp[key]) for key in keys}
    columns = max(len(levels) for levels in shown.values())
    size = figure_style.WIDTH_IN, 2.6 * len(keys)
    figure, axes = plt.subplots(len(keys), columns * len(prints), figsize=size, squeeze=False)
    for row, key in zip(axes, keys, strict=True):
        for axis in row:
            axis.set_axis_off()
        for at, kind in enumerate(prints):
            strips = results[f"{key}-{kind}"]["strips"]
            for axis, (index, name) in zip(row[at * columns :], shown[key].items(), strict=False):
                axis.imshow(strips[index], cmap="gray", vmin=0, vmax=255)
                level = level_text(SWEEPS[key], float(cmp[key].levels[index]))
                axis.set_title(f"{kind.upper()} {level}\n{name}", fontsize=7)
    return figure_style.save(figure, path)


def _shown_levels(sweep: Sweep, cmp: Endurance) -> dict[int, str]:
    """Indices of the levels to show and what is to be said of them."""
    shown = {0: "good"}
    if sweep.paper_limit is not None:
        shown[int(np.argmin(np.abs(cmp.levels - sweep.paper_limit)))] = "paper's limit"
    first = cmp.fails_at
    if first is None:
        shown.setdefault(len(cmp.levels) - 1, "last")
        return shown
    if first > 0:
        shown.setdefault(first - 1, "CMP works")
    shown[first] = "CMP begins to fail"
    return shown
