"""The report of a material calibration: reference against reading, loads and parameters."""

from __future__ import annotations

from html import escape
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.calibration_page import write_page
from cmp_tactile_bringup.report.load_rows import LOAD_HEADINGS, load_rows
from cmp_tactile_processing.calibration.material_outcome import LoadResult, MaterialOutcome

__all__ = ["material_figure", "write_material_report"]

CAPTION = (
    "The force that the sensor shows against the force that is known, before and after. On the "
    "line both agree; bars reach two standard deviations of noise and material either way. Right: "
    "what is left."
)
AXES = ("Fx", "Fy", "Fz")
MARKS = ("^", "s", "o")
# Standard deviations that a bar reaches: 95 % of a normal error lies within.
BAR = 2.0


def write_material_report(outcome: MaterialOutcome, folder: Path, name: str) -> Path:
    """Write the figure and index.html into the folder; returns the page's path."""
    figures = [("loads.png", CAPTION, lambda: material_figure(outcome))] if outcome.loads else []
    return write_page(outcome, figures, folder, (name, "loads tell"), _loads_table(outcome))


def material_figure(outcome: MaterialOutcome) -> Figure:
    """Reading against reference before and after, and what is left, for all known components."""
    figure = style.new_figure(12.0, 5.6)
    left, right = figure.subplots(1, 2)
    used = [load for load in outcome.loads if load.used]
    unused = [load for load in outcome.loads if not load.used]
    reference = _column(outcome.loads, "reference")
    low, high = min(0.0, np.nanmin(reference)), max(0.0, np.nanmax(reference))
    left.plot([low, high], [low, high], color=style.MUTED, lw=1, zorder=0)
    for axes in (left, right):
        _draw(axes, used, residual=axes is right)
        axes.set_xlabel("force that is known, N")
    if unused:
        left.plot(
            _column(unused, "reference").ravel(),
            _column(unused, "before").ravel(),
            "x",
            color=style.MUTED,
            label="left out",
        )
    right.axhline(0, color=style.MUTED, lw=1, zorder=0)
    left.set_ylabel("force that the sensor shows, N")
    right.set_ylabel("sensor minus known, N")
    style.title(left, "What the sensor shows of known loads", f"bars: {BAR:g} standard deviations")
    style.title(right, "What is left", "with the new material, and with the one before")
    left.legend(loc="best")
    return figure


def _draw(axes: Axes, loads: list[LoadResult], *, residual: bool) -> None:
    if not loads:
        return
    reference, after = _column(loads, "reference"), _column(loads, "after")
    before, std = _column(loads, "before"), _column(loads, "after_std")
    if residual:
        before, after = before - reference, after - reference
        std = np.hypot(std, _column(loads, "reference_std"))
    for axis, name in enumerate(AXES):
        known = np.isfinite(reference[:, axis])
        if not known.any():
            continue
        x, colour = reference[known, axis], style.SERIES[axis]
        axes.plot(
            x,
            before[known, axis],
            MARKS[axis],
            color=colour,
            fillstyle="none",
            alpha=0.6,
            label=f"{name} before",
        )
        axes.errorbar(
            x,
            after[known, axis],
            np.nan_to_num(BAR * std[known, axis]),
            fmt=MARKS[axis],
            color=colour,
            capsize=4,
            ms=6,
            label=f"{name} after",
        )


def _column(loads: list[LoadResult] | tuple[LoadResult, ...], name: str) -> NDArray[np.float64]:
    return np.array([getattr(load, name) for load in loads], np.float64).reshape(-1, 3)


def _loads_table(outcome: MaterialOutcome) -> str:
    head = "".join(f"<th>{text}</th>" for text in LOAD_HEADINGS)
    lines = [
        "<tr>" + "".join(f'<td class="number">{escape(text)}</td>' for text in row.texts) + "</tr>"
        for row in load_rows(outcome.loads)
    ]
    return (
        f"<h2>Loads</h2><table><tr>{head}</tr>{''.join(lines)}</table>"
        "<p>Forces on the gel in the gel frame, N: into the gel is negative. Std: of noise and "
        "material, after.</p>"
    )
