"""What section IV.F comes to: where each method begins to fail."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from paper import figure_style
from paper.blocks import Claim, Figure, Report, Table, deviations, prose
from paper.chain import CMP
from paper.dot_tracking import ALL_METHODS
from paper.experiment import Arrays, Experiment, Results
from paper.experiments.reliability import PRESS_FRAMES, REST_FRAMES, SWEEPS, Sweep, cases

HALF = 0.5


@dataclass(frozen=True)
class Endurance:
    """How a method fares from level to level, from good to bad, (L,) each.

    success: share of the frames in which every visible marker is found and none bears a wrong
    number, of a gel that has its reference.  found: markers found of those visible.
    wrong: markers with wrong numbers.
    error: median over frames of the median error of a displacement, m; NaN without any.
    """

    levels: NDArray[np.float64]
    success: NDArray[np.float64]
    found: NDArray[np.float64]
    wrong: NDArray[np.int64]
    error: NDArray[np.float64]

    @classmethod
    def from_arrays(cls, arrays: Arrays, method: str) -> Endurance:
        """From the arrays of `reliability.expose_and_track`."""
        found, wrong, visible = (
            np.asarray(arrays[f"{method}_{name}"]) for name in ("found", "wrong", "visible")
        )
        over = tuple(range(1, found.ndim))
        referenced = np.asarray(arrays[f"{method}_referenced"])
        works = (found == visible) & (wrong == 0) & referenced[..., None]
        error = np.asarray(arrays[f"{method}_error"], dtype=np.float64).reshape(len(found), -1)
        median = np.full(len(error), np.nan)
        known = np.isfinite(error).any(axis=1)
        median[known] = np.nanmedian(error[known], axis=1)
        return cls(
            np.asarray(arrays["levels"], dtype=np.float64),
            works.mean(axis=over),
            found.sum(axis=over) / visible.sum(axis=over),
            wrong.sum(axis=over),
            median,
        )

    @property
    def fails_at(self) -> int | None:
        """Index of the first level where a marker is lost or has a wrong number in any frame."""
        return _first(self.success < 1)

    @property
    def half_lost_at(self) -> int | None:
        """Index of the first level where half of all markers are lost, or more."""
        return _first(self.found <= HALF)

    @property
    def bears(self) -> float | None:
        """The worst level before it begins to fail; None where it fails at the first."""
        first = self.fails_at
        if first == 0:
            return None
        return float(self.levels[-1 if first is None else first - 1])


def _first(where: NDArray[np.bool_]) -> int | None:
    return int(np.argmax(where)) if where.any() else None


Endurances = Mapping[tuple[str, str], Endurance]
OF_THE_PAPER = ("light", "contrast", "salt_and_pepper")


def report(results: Results, folder: Path) -> Report:
    """Figures, tables and claims."""
    endurances = endurances_of(results)
    cmp = {key: endurances[key, CMP.key] for key in SWEEPS}
    curves = draw_curves(endurances, OF_THE_PAPER, folder / "reliability_limits.png")
    strips = draw_strips(
        results, cmp, ("light", "salt_and_pepper"), folder / "reliability_frames.png"
    )
    blocks = (
        prose("reliability", "setup", rest=REST_FRAMES, press=len(PRESS_FRAMES)),
        prose("reliability", "definitions"),
        limits(endurances),
        Figure(curves, "What each method bears; to the right it gets worse. Dashed: the paper."),
        Figure(strips, "The middle of the left view at full press and shear, in either print."),
        prose("reliability", "shared"),
    )
    return Report(blocks, claims(endurances), deviations("reliability"))


def endurances_of(results: Results) -> Endurances:
    """By disturbance and method."""
    return {
        (key, method.key): Endurance.from_arrays(
            results[f"{key}-{method.pattern_type}"], method.key
        )
        for key in SWEEPS
        for method in ALL_METHODS
    }


def limits(endurances: Endurances) -> Table:
    """Where each method begins to fail, and where half of its markers are lost."""
    head = ("method", *(f"{sweep.title}: {sweep.level}" for sweep in SWEEPS.values()))
    rows = tuple(
        (
            method.label,
            *(_limit_text(SWEEPS[key], endurances[key, method.key]) for key in SWEEPS),
        )
        for method in ALL_METHODS
    )
    caption = (
        "The first level that fails (in brackets: the one from which on half of the markers are "
        "lost)."
    )
    return Table(head, rows, caption)


def _limit_text(sweep: Sweep, endurance: Endurance) -> str:
    first, half = endurance.fails_at, endurance.half_lost_at
    if first is None:
        return f"none to {level_text(sweep, float(endurance.levels[-1]))}"
    lost = "never" if half is None else level_text(sweep, float(endurance.levels[half]))
    return f"{level_text(sweep, float(endurance.levels[first]))} ({lost})"


def claims(endurances: Endurances) -> tuple[Claim, ...]:
    """The paper's limits beside ours."""
    light, contrast, noise = (endurances[key, CMP.key] for key in OF_THE_PAPER)
    least_light = light.bears
    most_noise = noise.bears
    return (
        Claim(
            "IV.F",
            "CMP works in uneven light",
            "works for ratios > 0.4",
            _range_text("light", light),
            least_light is not None and least_light <= _limit("light"),
        ),
        Claim(
            "IV.F",
            "CMP works at low visibility",
            "did not fail at the visibility that the simulation provided (not stated)",
            _range_text("contrast", contrast),
            None,
        ),
        Claim(
            "IV.F",
            "CMP under salt and pepper",
            "begins to fail at SNR < 0.95 (read as more than 5 % of the pixels spoilt)",
            _range_text("salt_and_pepper", noise),
            most_noise is not None and most_noise >= _limit("salt_and_pepper"),
        ),
    )


def _limit(key: str) -> float:
    limit = SWEEPS[key].paper_limit
    return float("nan") if limit is None else limit


def _range_text(key: str, endurance: Endurance) -> str:
    sweep, first = SWEEPS[key], endurance.fails_at
    if endurance.bears is None:
        return "fails without it"
    bears = level_text(sweep, endurance.bears)
    if first is None:
        return f"works to {bears}, the last level tried"
    found = np.round(100 * endurance.found[first], 1)
    at = level_text(sweep, float(endurance.levels[first]))
    return f"works to {bears}; begins to fail at {at} ({found:.3g} % of the markers found there)"


EXPERIMENT = Experiment(
    key="reliability",
    section="IV.F",
    title="Reliability in uneven light and noise",
    cases=cases,
    report=report,
)


ROW_HEIGHT_IN = 1.9
LARGEST_MARKER, SMALLER_BY = 9.0, 1.4


def level_text(sweep: Sweep, level: float) -> str:
    """A level as a reader takes it."""
    return f"{level:.0%}".replace("%", " %") if sweep.percent else f"{level:.2g}"


def draw_curves(
    endurances: Mapping[tuple[str, str], Endurance], keys: Sequence[str], path: Path
) -> Path:
    """Success, markers found and error over the levels of some sweeps, of every method."""
    height = 3 * ROW_HEIGHT_IN + 0.5
    figure, axes = figure_style.panels(3, len(keys), height, sharex="col", squeeze=False)
    for column, key in zip(axes.T, keys, strict=True):
        sweep = SWEEPS[key]
        for number, method in enumerate(ALL_METHODS):
            endurance = endurances[key, method.key]
            rows = 100 * endurance.success, 100 * endurance.found, 1e6 * endurance.error
            for axis, values in zip(column, rows, strict=True):
                axis.plot(
                    endurance.levels,
                    values,
                    **figure_style.look(method.key),
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
    figure_style.legend(figure, axes[0, 0], 3)
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
    prints = ("cmp", "dmp")
    shown = {key: _shown_levels(SWEEPS[key], cmp[key]) for key in keys}
    columns = max(len(levels) for levels in shown.values())
    height = 2.6 * len(keys)
    figure, axes = figure_style.panels(len(keys), columns * len(prints), height, squeeze=False)
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
