"""Figure: the resultant force and moment over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.force_evaluation import BAND
from cmp_tactile_bringup.report.results import DemoResults

__all__ = ["draw_phases", "wrench_figure"]

AXES = ("x", "y", "z")
SHORT_PHASE_FRAMES = 2


def wrench_figure(results: DemoResults) -> Figure:
    """Depth, force and moment over time with the truth, and their errors within the error bar."""
    figure = style.new_figure(13.4, 13.4)
    depth, *panels = figure.subplots(5, 1, sharex=True, height_ratios=[0.8, 1.2, 0.9, 1.0, 0.9])
    time_s = results.time_s
    moved = np.stack([frame.surface.displacement for frame in results.frames]) * 1e3
    _draw_line(depth, time_s, _largest(-moved[..., 2]), style.INK, "deepest")
    sideways = np.linalg.norm(moved[..., :2], axis=-1)
    _draw_line(depth, time_s, _largest(sideways), style.OBJECT, "largest sideways")
    _draw_wrench(panels[0], panels[1], results, _Part("F", "force, N", "N", slice(0, 3), 1.0))
    _draw_wrench(
        panels[2], panels[3], results, _Part("M", "moment, N mm", "N mm", slice(3, 6), 1e3)
    )
    depth.set_ylabel("moved, mm")
    for axes in (depth, *panels):
        axes.axhline(0, color=style.MUTED, lw=0.8, zorder=0)
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.4)
        draw_phases(axes, results, names=axes is depth)
    panels[-1].set_xlabel("time of the recording, s")
    panels[-1].set_xlim(time_s[0] - 0.01, time_s[-1] + 0.01)
    depth.set_title("What the sensor felt: the force of the object on the gel over time", pad=30)
    figure.align_ylabels()
    return figure


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
    truth_s = (truth.stamp_ns - truth.stamp_ns[0]).astype(np.float64) * 1e-9
    true = truth.wrench[:, part.columns] * part.factor
    measured = np.stack([frame.force.wrench[part.columns] for frame in frames]) * part.factor
    std = np.stack([frame.force.wrench_std[part.columns] for frame in frames]) * part.factor
    error = measured - true[[frame.index for frame in frames]]
    for number, name in enumerate(AXES):
        colour, label = style.SERIES[number], f"{part.letter}{name}"
        values.plot(truth_s, true[:, number], color=colour, lw=5, alpha=0.3)
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
        errors.annotate("came without error bars", (0.01, 0.05), xycoords="axes fraction")


def _largest(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The largest of each frame (n, ...); NaN where a frame has none."""
    flat = values.reshape(len(values), -1)
    known = np.isfinite(flat).any(axis=1)
    found = np.full(len(flat), np.nan)
    found[known] = np.nanmax(flat[known], axis=1)
    return found


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
