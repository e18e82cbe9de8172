"""Figure: the contacts over time: how many, how large, whether they slip, and what was flagged."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.force_evaluation import BAND
from cmp_tactile_bringup.report.results import DemoResults
from cmp_tactile_bringup.report.wrench_figure import draw_phases
from cmp_tactile_processing.force_advice import flag_names, single_flags
from cmp_tactile_processing.force_field import ForceFlag, SlipState

__all__ = ["contact_figure"]

STATES = {
    SlipState.NO_CONTACT: ("no contact", style.MUTED),
    SlipState.STICK: ("sticks", style.SERIES[2]),
    SlipState.INCIPIENT: ("begins to slip", style.COLUMN),
    SlipState.FULL: ("slips", style.OBJECT),
}
MEASURED, TRUE = style.SERIES[0], style.MUTED
Panel = Callable[[Axes], None]


def contact_figure(results: DemoResults) -> Figure:
    """Number and area of the contacts, slip and friction, flags; panels only of what was told."""
    panels: list[tuple[float, Panel]] = [
        (0.7, lambda axes: _draw_number(axes, results)),
        (1.0, lambda axes: _draw_area(axes, results)),
    ]
    left_out = []
    slip, friction = _slip(results, "slip_ratio"), _slip(results, "traction_ratio")
    if np.isfinite(slip).any() or _states(results).any():
        panels += [
            (0.5, lambda axes: _draw_states(axes, results)),
            (0.9, lambda axes: _draw_slip(axes, results)),
        ]
    else:
        left_out.append("slip: no frame told whether the contact slips")
    if np.isfinite(friction).any():
        panels.append((1.2, lambda axes: _draw_friction(axes, results)))
    else:
        left_out.append("friction: no frame told a ratio of tangential to normal force")
    if _flags(results):
        panels.append((0.4, lambda axes: _draw_flags(axes, results)))
    else:
        left_out.append("flags: none was set")
    heights = [height for height, _ in panels]
    figure = style.new_figure(13.4, 1.2 + 2.2 * sum(heights))
    rows = figure.subplots(len(panels), 1, sharex=True, height_ratios=heights)
    for axes, (_, draw) in zip(rows, panels, strict=True):
        draw(axes)
        draw_phases(axes, results, names=axes is rows[0])
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.4)
    rows[0].set_title("The contacts over time", pad=30)
    rows[-1].set_xlabel("time of the recording, s")
    rows[-1].set_xlim(results.time_s[0] - 0.01, results.time_s[-1] + 0.01)
    if left_out:
        figure.supxlabel("Left out. " + "; ".join(left_out), x=0.01, ha="left", fontsize=10)
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
    _draw_measured(axes, results, area * 1e6, "measured")
    axes.set_ylabel("area, mm²")
    axes.set_ylim(bottom=0)


def _draw_states(axes: Axes, results: DemoResults) -> None:
    """Two bands of colour: what was told, and what is true."""
    truth = results.recording.truth
    bands = (
        (1.0, results.time_s, _states(results)),
        (0.0, _truth_s(results), truth.slip_state.astype(np.int64)),
    )
    step_s = float(np.median(np.diff(_truth_s(results))))
    for base, time_s, states in bands:
        for state, (_, colour) in STATES.items():
            spans = [(time - step_s / 2, step_s) for time in time_s[states == state]]
            axes.broken_barh(spans, (base + 0.1, 0.8), color=colour, lw=0, zorder=2)
    shown = set(_states(results).tolist()) | set(truth.slip_state.tolist())
    for state, (name, colour) in STATES.items():
        if state in shown:
            axes.plot([], [], color=colour, lw=8, label=name)
    axes.set_yticks([0.5, 1.5], ["true", "measured"])
    axes.set_ylim(0, 2)


def _draw_slip(axes: Axes, results: DemoResults) -> None:
    _draw_true(axes, results, results.recording.truth.slip_ratio)
    _draw_measured(axes, results, _slip(results, "slip_ratio"), "measured")
    axes.set(ylabel="share that slides", ylim=(-0.05, 1.05))


def _draw_friction(axes: Axes, results: DemoResults) -> None:
    truth = results.recording.truth
    _draw_true(axes, results, truth.traction_ratio, style.SERIES[0], "true")
    _draw_measured(axes, results, _slip(results, "traction_ratio"), "friction that is used")
    coefficient, std = _slip(results, "friction_coefficient"), _slip(results, "friction_std")
    colour = style.SERIES[1]
    _draw_true(axes, results, truth.friction_coefficient, colour, "")
    told = np.isfinite(coefficient)
    if told.any():
        axes.errorbar(
            results.time_s[told],
            coefficient[told],
            yerr=BAND * np.nan_to_num(std[told]),
            color=colour,
            marker="o",
            ms=4,
            ls="none",
            capsize=3,
            label=f"coefficient, ±{BAND:g} std",
        )
    axes.set_ylabel("tangential / normal")
    finite = [v[np.isfinite(v)] for v in (truth.friction_coefficient, coefficient)]
    ratio = _slip(results, "traction_ratio")
    highest = max([1.0, *np.concatenate([*finite, ratio[np.isfinite(ratio)]]).tolist()])
    axes.set_ylim(0, min(1.1 * highest, 2.5))


def _draw_flags(axes: Axes, results: DemoResults) -> None:
    """A row of marks for each flag, where it was set."""
    flags = _flags(results)
    for row, flag in enumerate(flags):
        time_s = [
            time
            for time, frame in zip(results.time_s, results.frames, strict=True)
            if frame.force.flags & flag
        ]
        axes.plot(time_s, [row] * len(time_s), marker="s", ls="none", color=style.MARKER, ms=6)
    axes.set_yticks(range(len(flags)), [flag_names(flag) for flag in flags])
    axes.set_ylim(-0.7, len(flags) - 0.3)


def _draw_true(
    axes: Axes,
    results: DemoResults,
    values: NDArray[np.float64],
    colour: str = TRUE,
    label: str = "true",
) -> None:
    """A broad line of what is true, where the recording tells it."""
    if np.isfinite(values).any():
        axes.plot(_truth_s(results), values, color=colour, lw=5, alpha=0.35, label=label or None)


def _draw_measured(
    axes: Axes, results: DemoResults, values: NDArray[np.float64], label: str
) -> None:
    axes.plot(results.time_s, values, color=MEASURED, lw=1.8, marker="o", ms=3, label=label)


def _truth_s(results: DemoResults) -> NDArray[np.float64]:
    stamps = results.recording.truth.stamp_ns
    return (stamps - stamps[0]).astype(np.float64) * 1e-9


def _slip(results: DemoResults, figure: str) -> NDArray[np.float64]:
    return np.array([getattr(frame.force.slip, figure) for frame in results.frames], np.float64)


def _states(results: DemoResults) -> NDArray[np.int64]:
    """Slip state of each frame, but 0 throughout where it only tells contact from none."""
    states = np.array([frame.force.slip_state for frame in results.frames], np.int64)
    told = np.isin(states, (SlipState.STICK, SlipState.INCIPIENT, SlipState.FULL)).any()
    return states if told else np.zeros_like(states)


def _flags(results: DemoResults) -> list[ForceFlag]:
    """The flags that were set in any frame."""
    every = ForceFlag.NONE
    for frame in results.frames:
        every |= frame.force.flags
    return list(single_flags(every))
