"""Figure: the resultant force and moment over time."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.results import DemoResults

__all__ = ["draw_phases", "wrench_figure"]

AXES = ("x", "y", "z")
SHORT_PHASE_FRAMES = 2


def wrench_figure(results: DemoResults) -> Figure:
    """Depth of the press, force and moment over time, and the true ones as broad lines."""
    figure = style.new_figure(13.4, 8.2)
    depth, force, moment = figure.subplots(3, 1, sharex=True, height_ratios=[0.8, 1.2, 1.0])
    time_s, wrench = results.time_s, np.stack([frame.force.wrench for frame in results.frames])
    moved = np.stack([frame.surface.displacement for frame in results.frames]) * 1e3
    _draw_line(depth, time_s, -np.nanmin(moved[..., 2], axis=(1, 2)), style.INK, "deepest")
    sideways = np.linalg.norm(moved[..., :2], axis=-1)
    _draw_line(depth, time_s, np.nanmax(sideways, axis=(1, 2)), style.OBJECT, "largest sideways")
    truth = results.recording.truth
    truth_s = (truth.stamp_ns - truth.stamp_ns[0]).astype(np.float64) * 1e-9
    for axes, letter, first, factor in ((force, "F", 0, 1.0), (moment, "M", 3, 1e3)):
        for number, name in enumerate(AXES):
            column, colour = first + number, style.SERIES[number]
            axes.plot(truth_s, truth.wrench[:, column] * factor, color=colour, lw=5, alpha=0.3)
            _draw_line(axes, time_s, wrench[:, column] * factor, colour, f"{letter}{name}")
    force.plot([], [], color=style.MUTED, lw=5, alpha=0.4, label="true")
    for axes, label in ((depth, "moved, mm"), (force, "force, N"), (moment, "moment, N mm")):
        axes.set_ylabel(label)
        axes.axhline(0, color=style.MUTED, lw=0.8, zorder=0)
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.4)
        draw_phases(axes, results, names=axes is depth)
    moment.set_xlabel("time of the recording, s")
    moment.set_xlim(time_s[0] - 0.01, time_s[-1] + 0.01)
    depth.set_title("What the sensor felt: the force of the object on the gel over time", pad=30)
    figure.align_ylabels()
    return figure


def draw_phases(axes: Axes, results: DemoResults, *, names: bool) -> None:
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
