"""The report of a material calibration: reference against reading, loads and parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from html import escape
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.calibration.load_rows import (
    AXES,
    LOAD_HEADINGS,
    load_rows,
    told_components,
)
from cmp_tactile_bringup.report.calibration.page import write_page
from cmp_tactile_processing.calibration.material.loads import LoadResult, MaterialOutcome

__all__ = ["material_figure", "write_material_report"]

CAPTION = (
    "The force that the sensor shows against the force that is known, before and after. On the "
    "line both agree; bars reach two standard deviations of noise and material either way. Right: "
    "what is left."
)
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
    points = _Points.from_loads(outcome.loads)
    ends = [min(0.0, points.known.min(initial=0.0)), max(0.0, points.known.max(initial=0.0))]
    left.plot(ends, ends, color=style.MUTED, lw=1, zorder=0)
    right.axhline(0, color=style.MUTED, lw=1, zorder=0)
    for axis, name in enumerate(AXES):
        own = points.chosen(points.used & (points.axis == axis))
        if not own.known.size:
            continue
        look = {"color": style.SERIES[axis], "marker": MARKS[axis], "ls": "none", "ms": 6}
        left.plot(own.known, own.before, **look, fillstyle="none", label=f"{name} before")
        left.errorbar(own.known, own.after, BAR * own.std, **look, capsize=4, label=f"{name} after")
        bars = BAR * np.hypot(own.std, own.known_std)
        right.errorbar(own.known, own.after - own.known, bars, **look, capsize=4)
    unused = points.chosen(~points.used)
    if unused.known.size:
        left.plot(unused.known, unused.before, "x", color=style.MUTED, label="left out")
    for axes, label in ((left, "force that the sensor shows, N"), (right, "shown minus known, N")):
        axes.set_xlabel("force that is known, N")
        axes.set_ylabel(label)
        axes.margins(0.08)
    meaning = f"bars: {BAR:g} standard deviations"
    style.title(left, "What the sensor shows of known loads", f"{meaning}, after")
    style.title(right, "What is left with the new material", f"{meaning} of sensor and load")
    left.legend(loc="best")
    return figure


@dataclass(frozen=True)
class _Points:
    """The components that are known, of all loads, each (n,)."""

    axis: NDArray[np.intp]
    used: NDArray[np.bool_]
    known: NDArray[np.float64]
    known_std: NDArray[np.float64]
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    std: NDArray[np.float64]

    @classmethod
    def from_loads(cls, loads: Sequence[LoadResult]) -> _Points:
        told = [np.flatnonzero(told_components(load)) for load in loads]

        def joined(name: str) -> NDArray[np.float64]:
            parts = [getattr(load, name)[axes] for load, axes in zip(loads, told, strict=True)]
            return np.concatenate([np.zeros(0), *parts])

        return cls(
            axis=np.concatenate([np.zeros(0, np.intp), *told]),
            used=np.repeat([load.used for load in loads], [len(axes) for axes in told]).astype(
                bool
            ),
            known=joined("reference"),
            known_std=joined("reference_std"),
            before=joined("before"),
            after=joined("after"),
            std=np.nan_to_num(joined("after_std")),
        )

    def chosen(self, which: NDArray[np.bool_]) -> _Points:
        return _Points(*(getattr(self, item.name)[which] for item in fields(self)))


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
