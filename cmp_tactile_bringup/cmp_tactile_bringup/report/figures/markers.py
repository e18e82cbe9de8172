"""Figures: gridlines in the camera frame; the moment when all markers jumped."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.evaluation import DemoResults, FrameResult, Jump, find_jump
from cmp_tactile_processing.measured import Grid, Status

Window = tuple[float, float, float, float]
"""A part of the frame: x from, x to, y from, y to, px."""
MARGIN_PX = 45

ZOOM_CHECKERS = 2.6
# Of the grid's rows and columns, 0 to 1.
SHOWN = ((0.75, 0.1), (0.25, 0.3), (0.5, 0.5), (0.75, 0.7), (0.25, 0.9))
OUTLINE = [patheffects.withStroke(linewidth=3, foreground="black")]


def frame_figure(results: DemoResults, index: int) -> Figure:
    """The whole frame with both grids, and a close look at the same corner in both views."""
    frame = results.frame(index)
    figure = style.new_figure(13.4, 7.6)
    axes = figure.subplot_mosaic([["frame", "left"], ["frame", "right"]], width_ratios=[2.75, 1])
    draw_frame(axes["frame"], frame)
    found = int(sum((g.corner_status == Status.MEASURED).sum() for g in (frame.left, frame.right)))
    points = sum(_measured_line_points(g) for g in (frame.left, frame.right))
    style.title(
        axes["frame"],
        f"What the camera sees: frame {frame.index}, both mirror views",
        f"{found} crossings and {points} points on the gridlines between them, found and numbered",
    )
    corner = _deepest_corner(frame)
    for name, grid in (("left", frame.left), ("right", frame.right)):
        x = float(np.nanmean(grid.corners_frame[..., 0]))
        axes["frame"].text(x, 725, f"{name} view", color="white", ha="center", fontsize=12)
        _draw_zoom(axes[name], frame.image, grid, corner)
        style.title(axes[name], f"Close up, {name} view")
        _frame_the_zoom(axes["frame"], axes[name])
    axes["right"].legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=2, fontsize=9.5, handletextpad=0.3
    )
    return figure


def draw_frame(axes: Axes, frame: FrameResult, line_width: float = 1.0) -> None:
    """The frame with the gridlines of both views; line width in points."""
    _draw_image(axes, frame.image)
    for grid in (frame.left, frame.right):
        _draw_lines(axes, grid, line_width)
    axes.set_axis_off()


def left_view_window(frames: Sequence[FrameResult]) -> Window:
    """The part of the frame in which the left grid was, in any of these frames."""
    corners = np.concatenate([frame.left.corners_frame.reshape(-1, 2) for frame in frames])
    low, high = np.nanmin(corners, axis=0) - MARGIN_PX, np.nanmax(corners, axis=0) + MARGIN_PX
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _gridlines(grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gridlines along the rows and along the columns, px of the frame.

    (rows, (cols - 1) (n + 1) + 1, 2) and (cols, (rows - 1) (n + 1) + 1, 2): corners with the
    virtual markers between them, in order.
    """
    corners = grid.corners_frame
    along_rows = _chain(corners, grid.row_lines_frame)
    col_lines = grid.col_lines_frame.transpose(1, 0, 2, 3)
    return along_rows, _chain(corners.transpose(1, 0, 2), col_lines)


def _chain(corners: NDArray[np.float64], between: NDArray[np.float64]) -> NDArray[np.float64]:
    """(a, b, 2) corners and (a, b - 1, n, 2) points between them -> (a, (b - 1)(n + 1) + 1, 2)."""
    pieces = np.concatenate([corners[:, :-1, None], between], axis=2)
    return np.concatenate([pieces.reshape(len(corners), -1, 2), corners[:, -1:]], axis=1)


def _draw_image(axes: Axes, image: NDArray[np.uint8]) -> None:
    axes.imshow(image, cmap="gray", vmin=0, vmax=255)


def _draw_lines(axes: Axes, grid: Grid, width: float) -> None:
    for lines, colour in zip(_gridlines(grid), (style.ROW, style.COLUMN), strict=True):
        axes.add_collection(LineCollection(list(lines), colors=colour, linewidths=width))


def _draw_zoom(axes: Axes, image: NDArray[np.uint8], grid: Grid, corner: tuple[int, int]) -> None:
    _draw_image(axes, image)
    _draw_lines(axes, grid, 1.2)
    for name, points, size, colour in (
        ("virtual marker", grid.row_lines_frame, 10.0, style.VIRTUAL),
        ("", grid.col_lines_frame, 10.0, style.VIRTUAL),
        ("measured marker", grid.corners_frame, 46.0, style.MARKER),
    ):
        x, y = points.reshape(-1, 2).T
        axes.scatter(x, y, s=size, color=colour, edgecolor="black", lw=0.5, zorder=3, label=name)
    centre, half = grid.corners_frame[corner], ZOOM_CHECKERS * _checker_px(grid, corner)
    axes.set_xlim(centre[0] - half, centre[0] + half)
    axes.set_ylim(centre[1] + half, centre[1] - half)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set(visible=True, color=style.INK, linewidth=1.5)


def _frame_the_zoom(frame_axes: Axes, zoom_axes: Axes) -> None:
    (left, right), (bottom, top) = zoom_axes.get_xlim(), zoom_axes.get_ylim()
    outline = [(left, top), (right, top), (right, bottom), (left, bottom), (left, top)]
    frame_axes.plot(*np.transpose(outline), color="white", lw=2.5)
    frame_axes.plot(*np.transpose(outline), color=style.INK, lw=1.2)


def _deepest_corner(frame: FrameResult) -> tuple[int, int]:
    row, col = np.unravel_index(
        np.nanargmin(frame.surface.displacement[..., 2]), frame.surface.status.shape
    )
    return int(row), int(col)


def _checker_px(grid: Grid, corner: tuple[int, int]) -> float:
    distance = np.linalg.norm(grid.corners - grid.corners[corner], axis=-1)
    return float(np.sort(distance[np.isfinite(distance)])[1])


def _measured_line_points(grid: Grid) -> int:
    status = (grid.row_line_status, grid.col_line_status)
    return int(sum((item == Status.MEASURED).sum() for item in status))


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
    _draw_image(axes, frame.image)
    _draw_lines(axes, frame.left, 0.7)
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
