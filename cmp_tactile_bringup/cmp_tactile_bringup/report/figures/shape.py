"""Figure: the shape of the touched gel between the markers, from above and in section."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.figures.displacement import depth_scale
from cmp_tactile_bringup.report.results import DemoResults
from cmp_tactile_processing.surface.dense import DenseStatus, HeightMap, height_map, interpolate

__all__ = ["shape_figure"]

# Nodes to a checker, and how far beyond the outermost markers, in checkers.
NODES_PER_PITCH, MARGIN_PITCHES = 10, 0.5
CONTOURS_MM = 0.1
# Height over width of the section.
SECTION_SHAPE = 0.7


def shape_figure(results: DemoResults, index: int) -> Figure:
    """How far the gel is pressed in over space, and the section through the deepest place."""
    pitch = results.sensor.pattern.pitch
    surface = results.frame(index).surface
    dense = interpolate(surface, pitch / NODES_PER_PITCH, MARGIN_PITCHES * pitch)
    now = height_map(dense)
    rest = height_map(replace(dense, position=dense.reference))
    figure = style.new_figure(13.4, 6.0)
    grid = figure.add_gridspec(1, 2, width_ratios=[1, 1.2])
    plan, section = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    pressed = (rest.height - now.height) * 1e3
    deepest = np.unravel_index(np.nanargmax(np.nan_to_num(pressed)), pressed.shape)
    _draw_plan(plan, now, pressed, int(deepest[0]), depth_scale(results))
    style.title(
        plan,
        f"Pressed in, frame {index}",
        "mm, over the places that it now has; hatched: extrapolated",
    )
    factor = _draw_section(section, now, rest, int(deepest[0]))
    style.title(section, "Section along x through the deepest place", f"Heights x {factor}")
    return figure


def _draw_plan(
    axes: Axes, now: HeightMap, pressed: NDArray[np.float64], row: int, scale: object
) -> None:
    x, y = now.grid.x * 1e3, now.grid.y * 1e3
    half = now.grid.spacing[0] * 1e3 / 2
    extent = (x[0] - half, x[-1] + half, y[0] - half, y[-1] + half)
    image = axes.imshow(
        pressed,
        origin="lower",
        extent=extent,
        cmap=style.DEPTH_MAP,
        norm=scale,  # type: ignore[arg-type]
    )
    most = max(float(np.nanmax(pressed, initial=0.0)), CONTOURS_MM)
    levels = np.arange(CONTOURS_MM, most + CONTOURS_MM, CONTOURS_MM)
    axes.contour(x, y, np.nan_to_num(pressed), levels=levels, colors=style.INK, linewidths=0.5)
    beyond = now.status == DenseStatus.EXTRAPOLATED
    axes.contourf(x, y, beyond, levels=[0.5, 1.5], hatches=["///"], colors="none")
    axes.axhline(y[row], color=style.SERIES[1], lw=1.0, ls="--")
    bar = axes.figure.colorbar(image, ax=axes, location="left", pad=0.02, shrink=0.85)
    bar.set_label("pressed in, mm")
    axes.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")


def _draw_section(axes: Axes, now: HeightMap, rest: HeightMap, row: int) -> int:
    """Returns how many times larger heights are drawn than lengths."""
    x = now.grid.x * 1e3
    known = now.status[row] != DenseStatus.EXTRAPOLATED
    z = now.height[row] * 1e3
    axes.plot(x, rest.height[row] * 1e3, color=style.MUTED, lw=1.2, label="at rest")
    axes.plot(x, z, color=style.SERIES[1], lw=1.0, ls=":", label="extrapolated")
    axes.plot(x, np.where(known, z, np.nan), color=style.SERIES[1], lw=2.0, label="now")
    axes.legend(loc="center")
    axes.set(xlabel="x, mm", ylabel="z, mm")
    axes.grid(alpha=0.25)
    heights = np.concatenate([z, rest.height[row] * 1e3])
    span_mm = max(float(np.nanmax(heights) - np.nanmin(heights)), 0.01)
    factor = max(int(SECTION_SHAPE * (x[-1] - x[0]) / span_mm), 1)
    axes.set_aspect(factor)
    return factor
