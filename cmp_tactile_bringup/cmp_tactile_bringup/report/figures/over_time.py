"""Figures over time: the resultant force and moment; the contacts, slip and friction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.evaluation import BAND
from cmp_tactile_bringup.report.results import DemoResults
from cmp_tactile_processing.force.advice import SLIP_WORDS
from cmp_tactile_processing.measured import SlipState

AXES = ("x", "y", "z")
SHORT_PHASE_FRAMES = 2
STATES = {
    SlipState.NO_CONTACT: style.MUTED,
    SlipState.STICK: style.SERIES[2],
    SlipState.INCIPIENT: style.COLUMN,
    SlipState.FULL: style.OBJECT,
}
NOT_KNOWN: dict[str, Any] = {
    "facecolor": "white",
    "edgecolor": style.MUTED,
    "hatch": "////",
    "lw": 0,
}
TIME_LABEL = (
    "time of the recording, s\n"
    "stripes: phases of the motion, named at the top; orange: a phase of a single frame"
)
MEASURED, TRUE = style.SERIES[0], style.MUTED
Panel = Callable[[Axes, DemoResults], None]


def wrench_figure(results: DemoResults) -> Figure:
    """Depth, force and moment over time with the truth, and their errors within the error bar."""
    figure = style.new_figure(13.4, 13.4)
    depth, *panels = figure.subplots(5, 1, sharex=True, height_ratios=[0.8, 1.2, 0.9, 1.0, 0.9])
    time_s = results.time_s
    _draw_displacement(depth, results)
    _draw_wrench(panels[0], panels[1], results, _Part("F", "force, N", "N", slice(0, 3), 1.0))
    _draw_wrench(
        panels[2], panels[3], results, _Part("M", "moment, N mm", "N mm", slice(3, 6), 1e3)
    )
    for axes in (depth, *panels):
        axes.axhline(0, color=style.MUTED, lw=0.8, zorder=0)
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.4)
        _draw_phases(axes, results, names=axes is depth)
    panels[-1].set_xlabel(TIME_LABEL)
    panels[-1].set_xlim(time_s[0] - 0.01, time_s[-1] + 0.01)
    depth.set_title("Displacement of the gel; force and moment of the object on the gel", pad=30)
    figure.align_ylabels()
    return figure


def _draw_displacement(axes: Axes, results: DemoResults) -> None:
    """Largest depth and largest displacement along the gel of all markers."""
    positions = results.recording.truth.corners_m
    true = (positions - positions[0]) * 1e3
    measured = np.stack([frame.surface.displacement for frame in results.frames]) * 1e3
    for part, colour, label in (
        (lambda moved: -moved[..., 2], style.INK, "depth"),
        (lambda moved: np.linalg.norm(moved[..., :2], axis=-1), style.OBJECT, "along the gel"),
    ):
        _draw_true(axes, results, _largest(part(true)), colour, "")
        _draw_line(axes, results.time_s, _largest(part(measured)), colour, label)
    axes.plot([], [], color=style.MUTED, lw=5, alpha=0.4, label="true")
    axes.set_ylabel("largest\ndisplacement, mm")


@dataclass(frozen=True)
class _Part:
    """Force or moment.  columns: of the wrench.  factor: from SI to the unit."""

    letter: str
    label: str
    unit: str
    columns: slice
    factor: float


def _draw_wrench(values: Axes, errors: Axes, results: DemoResults, part: _Part) -> None:
    """Measured over true components, and below it how far they are apart, with the error bar."""
    truth, frames = results.recording.truth, results.frames
    true = truth.wrench[:, part.columns] * part.factor
    measured = np.stack([frame.force.wrench[part.columns] for frame in frames]) * part.factor
    std = np.stack([frame.force.wrench_std[part.columns] for frame in frames]) * part.factor
    error = measured - true[[frame.index for frame in frames]]
    for number, name in enumerate(AXES):
        colour, label = style.SERIES[number], f"{part.letter}{name}"
        values.plot(_truth_s(results), true[:, number], color=colour, lw=5, alpha=0.3)
        _draw_line(values, results.time_s, measured[:, number], colour, label)
        _draw_line(errors, results.time_s, error[:, number], colour, label)
        band = BAND * std[:, number]
        errors.fill_between(results.time_s, -band, band, color=colour, alpha=0.15, lw=0)
    values.plot([], [], color=style.MUTED, lw=5, alpha=0.4, label="true")
    values.set_ylabel(part.label)
    errors.set_ylabel(f"error, {part.unit}")
    if np.isfinite(std).any():
        errors.fill_between([], [], color=style.MUTED, alpha=0.3, lw=0, label=f"±{BAND:g} std")
    else:
        errors.annotate("without error bars", (0.01, 0.05), xycoords="axes fraction")


def _largest(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The largest of each frame (n, ...); NaN where a frame has none."""
    flat = values.reshape(len(values), -1)
    known = np.isfinite(flat).any(axis=1)
    found = np.full(len(flat), np.nan)
    found[known] = np.nanmax(flat[known], axis=1)
    return found


def _draw_phases(axes: Axes, results: DemoResults, *, names: bool) -> None:
    """Shade every second phase of the recording and write the phases' names above the axes."""
    starts = [phase.first_frame for phase in results.recording.phases]
    ends = [*starts[1:], len(results.recording.truth.stamp_ns)]
    stamps = results.recording.truth.stamp_ns
    step_s = float(np.median(np.diff(stamps))) * 1e-9
    for number, phase in enumerate(results.recording.phases):
        # Half a frame early: a phase begins between the frame before it and its first.
        begin, end = ((frame - 0.5) * step_s for frame in (starts[number], ends[number]))
        short = ends[number] - starts[number] < SHORT_PHASE_FRAMES
        colour = style.MARKER if short else style.MUTED
        if short or number % 2:
            axes.axvspan(begin, end, color=colour, alpha=0.25 if short else 0.1, lw=0)
        if names:
            axes.annotate(
                phase.name,
                ((begin + end) / 2, 1.0),
                xycoords=axes.get_xaxis_transform(),
                xytext=(0, 6),
                textcoords="offset points",
                ha="center",
                fontsize=10,
                color=style.MARKER if short else style.INK,
                weight="bold" if short else "normal",
            )


def _draw_line(axes: Axes, time_s: np.ndarray, values: np.ndarray, colour: str, label: str) -> None:
    axes.plot(time_s, values, color=colour, label=label, lw=1.8, marker="o", ms=3)


def contact_figure(results: DemoResults) -> Figure:
    """Number and area of the contacts, slip and friction; panels only of what is known."""
    panels: list[tuple[float, Panel]] = [(0.7, _draw_number), (1.0, _draw_area)]
    if np.isfinite(_slip(results, "slip_ratio")).any() or _states(results).any():
        panels += [(0.6, _draw_states), (0.9, _draw_slip)]
    if np.isfinite(_slip(results, "traction_ratio")).any():
        panels.append((1.2, _draw_friction))
    heights = [height for height, _ in panels]
    figure = style.new_figure(13.4, 1.2 + 2.2 * sum(heights))
    rows = figure.subplots(len(panels), 1, sharex=True, height_ratios=heights)
    for axes, (_, draw) in zip(rows, panels, strict=True):
        draw(axes, results)
        _draw_phases(axes, results, names=axes is rows[0])
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.4)
    rows[0].set_title("The contacts over time", pad=30)
    rows[-1].set_xlabel(TIME_LABEL)
    rows[-1].set_xlim(results.time_s[0] - 0.01, results.time_s[-1] + 0.01)
    figure.align_ylabels()
    return figure


def _draw_number(axes: Axes, results: DemoResults) -> None:
    counts = [len(frame.force.contacts) for frame in results.frames]
    axes.step(results.time_s, counts, where="mid", color=MEASURED, lw=2, label="measured")
    axes.set(ylabel="contacts", ylim=(-0.3, max([*counts, 1]) + 0.5))
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))


def _draw_area(axes: Axes, results: DemoResults) -> None:
    area = np.array([frame.force.contact_area for frame in results.frames])
    _draw_true(axes, results, results.recording.truth.contact_area * 1e6)
    _draw_line(axes, results.time_s, area * 1e6, MEASURED, "measured")
    axes.set_ylabel("area, mm²")
    axes.set_ylim(bottom=0)


def _draw_states(axes: Axes, results: DemoResults) -> None:
    """Two bands of colour: what was measured, and what is true."""
    bands = (
        (1.0, results.time_s, _states(results)),
        (0.0, _truth_s(results), true_states(results)),
    )
    step_s = float(np.median(np.diff(_truth_s(results))))
    shown: set[int] = set()
    for base, time_s, states in bands:
        shown |= set(states.tolist())
        for state in SlipState:
            look = {"color": STATES[state], "lw": 0} if state in STATES else NOT_KNOWN
            spans = [(time - step_s / 2, step_s) for time in time_s[states == state]]
            axes.broken_barh(spans, (base + 0.1, 0.8), zorder=2, **look)
    share = results.sensor.slip.incipient_ratio
    rules = {
        SlipState.INCIPIENT: f": {share:.0%} or more of the contact slides",
        SlipState.FULL: ": all of it slides; measured once\nthe tangential force no longer rises",
    }
    for state, colour in STATES.items():
        if state in shown:
            label = SLIP_WORDS[state] + rules.get(state, "")
            axes.plot([], [], color=colour, lw=8, label=label)
    if SlipState.UNKNOWN in shown:
        axes.fill_between([], [], label="hatched, or a gap below: not known", **NOT_KNOWN)
    if len(results.frames) < len(results.recording.truth.stamp_ns):
        words = "white: frame lost"
        axes.fill_between([], [], facecolor="white", edgecolor=style.MUTED, lw=0.8, label=words)
    axes.set_yticks([0.5, 1.5], ["true", "measured"])
    axes.set_ylim(0, 2)


def true_states(results: DemoResults) -> NDArray[np.int64]:
    """What is true of each frame by the sensor's rule, by which a rim may slide a little."""
    truth = results.recording.truth
    states = truth.slip_state.astype(np.int64)
    little = truth.slip_ratio < results.sensor.slip.incipient_ratio
    states[(states == SlipState.INCIPIENT) & little] = SlipState.STICK
    return states


def _draw_slip(axes: Axes, results: DemoResults) -> None:
    _draw_true(axes, results, results.recording.truth.slip_ratio)
    _draw_line(axes, results.time_s, _slip(results, "slip_ratio"), MEASURED, "measured")
    axes.set(ylabel="sliding share", ylim=(-0.05, 1.05))


def _draw_friction(axes: Axes, results: DemoResults) -> None:
    truth = results.recording.truth
    ratio, name = _slip(results, "traction_ratio"), "tangential over normal force"
    _draw_true(axes, results, truth.traction_ratio, style.SERIES[0], f"{name}, true")
    _draw_line(axes, results.time_s, ratio, MEASURED, f"{name}, measured")
    coefficient, std = _slip(results, "friction_coefficient"), _slip(results, "friction_std")
    colour = style.SERIES[1]
    _draw_true(axes, results, truth.friction_coefficient, colour, "friction coefficient, true")
    known = np.isfinite(coefficient)
    if known.any():
        axes.errorbar(
            results.time_s[known],
            coefficient[known],
            yerr=BAND * np.nan_to_num(std[known]),
            color=colour,
            marker="o",
            ms=4,
            ls="none",
            capsize=3,
            label=f"friction coefficient, measured, ±{BAND:g} std",
        )
    axes.set_ylabel("tangential / normal")
    finite = [v[np.isfinite(v)] for v in (truth.friction_coefficient, coefficient)]
    highest = max([1.0, *np.concatenate([*finite, ratio[np.isfinite(ratio)]]).tolist()])
    axes.set_ylim(0, min(1.1 * highest, 2.5))


def _draw_true(
    axes: Axes,
    results: DemoResults,
    values: NDArray[np.float64],
    colour: str = TRUE,
    label: str = "true",
) -> None:
    """A broad line of what is true, where the recording has it."""
    if np.isfinite(values).any():
        axes.plot(_truth_s(results), values, color=colour, lw=5, alpha=0.35, label=label or None)


def _truth_s(results: DemoResults) -> NDArray[np.float64]:
    stamps = results.recording.truth.stamp_ns
    return (stamps - stamps[0]).astype(np.float64) * 1e-9


def _slip(results: DemoResults, figure: str) -> NDArray[np.float64]:
    return np.array([getattr(frame.force.slip, figure) for frame in results.frames], np.float64)


def _states(results: DemoResults) -> NDArray[np.int64]:
    """Slip state of each frame, but 0 throughout where it only separates contact from none."""
    states = np.array([frame.force.slip_state for frame in results.frames], np.int64)
    known = np.isin(states, (SlipState.STICK, SlipState.INCIPIENT, SlipState.FULL)).any()
    return states if known else np.zeros_like(states)
