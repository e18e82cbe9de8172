"""Figure: the moment when all markers jumped, and that each of them kept its number."""

from __future__ import annotations

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.figures.frame import Window, gridlines, left_view_window
from cmp_tactile_bringup.report.results import DemoResults, FrameResult, Jump, find_jump

__all__ = ["knock_figure"]

# Of the grid's rows and columns, 0 to 1.
SHOWN = ((0.75, 0.1), (0.25, 0.3), (0.5, 0.5), (0.75, 0.7), (0.25, 0.9))
OUTLINE = [patheffects.withStroke(linewidth=3, foreground="black")]


def knock_figure(results: DemoResults) -> Figure:
    """Left view before and after the largest jump, with the same markers numbered; their paths."""
    jump = find_jump(results)
    before, after = results.frames[jump.before], results.frames[jump.after]
    markers = _shown_markers(results)
    figure = style.new_figure(13.4, 9.4)
    axes = figure.subplot_mosaic([["before", "after"], ["path", "path"]], height_ratios=[1.75, 1])
    window = left_view_window([before, after])
    for name, frame in (("before", before), ("after", after)):
        _draw_view(axes[name], frame, markers, window)
        time_s = results.time_s[jump.before if name == "before" else jump.after]
        style.title(axes[name], f"Frame {frame.index}, at {time_s:.3f} s", f"left view, {name}")
    _draw_moves(axes["after"], before, after, markers)
    _draw_paths(axes["path"], results, jump, markers)
    style.title(axes["path"], "The same five markers, followed by their numbers", _verdict(results))
    return figure


def _verdict(results: DemoResults) -> str:
    jump = find_jump(results)
    largest_mm = float(np.nanmax(jump.distance)) * 1e3
    checkers = largest_mm * 1e-3 / results.sensor.pattern.pitch
    after = results.frames[jump.after]
    lost = int((~np.isfinite(after.surface.position).all(axis=-1)).sum())
    return (
        f"Within one frame the markers jumped by up to {largest_mm:.2f} mm, "
        f"{checkers:.1f} checkers; markers lost: {lost} of {after.surface.status.size}"
    )


def _shown_markers(results: DemoResults) -> list[tuple[int, int]]:
    """Five corners spread over the grid, each in a column of its own so that the paths part."""
    rows, cols = results.sensor.pattern.rows, results.sensor.pattern.cols
    return [(round(i * (rows - 1)), round(j * (cols - 1))) for i, j in SHOWN]


def _draw_view(
    axes: Axes,
    frame: FrameResult,
    markers: list[tuple[int, int]],
    window: Window,
) -> None:
    axes.imshow(frame.image, cmap="gray", vmin=0, vmax=255)
    for lines, colour in zip(gridlines(frame.left), (style.ROW, style.COLUMN), strict=True):
        axes.plot(*np.moveaxis(lines, -1, 0).transpose(0, 2, 1), color=colour, lw=0.7)
    cols = frame.left.shape.cols
    for marker in markers:
        q = frame.left.corners_frame[marker]
        axes.plot(*q, "o", ms=9, mfc=style.MARKER, mec="white", mew=1.4, zorder=4)
        axes.annotate(
            f"{marker[0] * cols + marker[1]}",
            q,
            xytext=(8, 7),
            textcoords="offset points",
            color="white",
            weight="bold",
            fontsize=13,
            path_effects=OUTLINE,
            zorder=5,
        )
    axes.set_xlim(window[0], window[1])
    axes.set_ylim(window[3], window[2])
    axes.set_axis_off()


def _draw_moves(
    axes: Axes, before: FrameResult, after: FrameResult, markers: list[tuple[int, int]]
) -> None:
    for marker in markers:
        start, end = before.left.corners_frame[marker], after.left.corners_frame[marker]
        axes.plot(*start, "o", ms=9, mfc="none", mec="white", mew=1.6, path_effects=OUTLINE)
        arrow = {"arrowstyle": "-|>", "color": "white", "lw": 2.2, "shrinkA": 5, "shrinkB": 6}
        axes.annotate("", end, start, arrowprops={**arrow, "path_effects": OUTLINE}, zorder=3)


def _draw_paths(
    axes: Axes, results: DemoResults, jump: Jump, markers: list[tuple[int, int]]
) -> None:
    cols = results.sensor.pattern.cols
    sideways_mm: NDArray[np.float64] = results.positions[..., 0] * 1e3
    for marker in markers:
        path = sideways_mm[:, marker[0], marker[1]]
        axes.plot(results.time_s, path, "o-", ms=3, lw=1.4, color=style.SERIES[0])
        axes.annotate(
            f"{marker[0] * cols + marker[1]}",
            (results.time_s[-1], path[-1]),
            xytext=(7, 0),
            textcoords="offset points",
            va="center",
            weight="bold",
        )
    begin, end = results.time_s[jump.before], results.time_s[jump.after]
    axes.axvspan(begin, end, color=style.MARKER, alpha=0.25, lw=0)
    axes.set(xlabel="time of the recording, s", ylabel="x of the marker, mm")
