"""Figures: how far markers have moved, from above and in 3-D; the gel's shape between them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.evaluation import DemoResults
from cmp_tactile_processing.measured import Surface
from cmp_tactile_processing.surface.dense import DenseStatus, HeightMap, height_map, interpolate

EXAGGERATION = 3.0
EDGE_MM = 0.3
VIEW_DEG = {"elev": 32.0, "azim": -62.0}
# Nodes to a checker, and how far beyond the outermost markers, in checkers.
NODES_PER_PITCH, MARGIN_PITCHES = 10, 0.5
CONTOURS_MM = 0.1
# Height over width of the section.
SECTION_SHAPE = 0.7


def displacement_figure(results: DemoResults, index: int) -> Figure:
    """Arrows in the plane over the depth in colour; beside it the surface in 3-D."""
    frame = results.frame(index)
    surface, scale = frame.surface, depth_scale(results)
    figure = style.new_figure(13.4, 6.2)
    grid = figure.add_gridspec(1, 2, width_ratios=[1, 1.12])
    plan = figure.add_subplot(grid[0])
    solid = figure.add_subplot(grid[1], projection="3d")
    draw_displacement(plan, surface, scale)
    style.title(
        plan, f"Displacement of the markers, frame {index}", "Arrows to scale: from rest to now"
    )
    depths = ScalarMappable(scale, style.DEPTH_MAP)
    style.colour_bar(depths, [plan], "pressed in, mm", location="left", shrink=0.85)
    _draw_solid(solid, surface, scale)
    solid.set_title(f"The surface in 3-D, heights x {EXAGGERATION:g}; grey: at rest", pad=0)
    return figure


def depth_scale(results: DemoResults) -> Normalize:
    """Colours of the depth, mm: the same for all frames of the recording."""
    deepest = max(_depth_mm(frame.surface).max() for frame in results.frames)
    return Normalize(0.0, max(float(deepest), 0.01))


def draw_displacement(axes: Axes, surface: Surface, scale: Normalize, arrow_step: int = 1) -> None:
    """Depth in colour where the markers are now, arrows from where they were at rest; mm.

    arrow_step: draw an arrow for every so many rows and columns.
    """
    position, reference = surface.position * 1e3, surface.reference * 1e3
    seen = np.isfinite(position).all(axis=-1)
    axes.tricontourf(
        position[seen][:, 0],
        position[seen][:, 1],
        _depth_mm(surface)[seen],
        levels=np.linspace(scale.vmin or 0.0, scale.vmax or 1.0, 41),
        cmap=style.DEPTH_MAP,
        norm=scale,
        extend="both",
    )
    some = (slice(arrow_step // 2, None, arrow_step),) * 2
    start, moved = reference[some], (position - reference)[some]
    look = {"width": 0.0028 * arrow_step**0.5, "minlength": 0.0, "headwidth": 4.5}
    style.arrows(axes, start[..., :2], moved[..., :2], color=style.INK, **look)
    points = np.concatenate([reference[seen], position[seen]])[:, :2]
    (left, bottom), (right, top) = points.min(axis=0) - EDGE_MM, points.max(axis=0) + EDGE_MM
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.set(xlabel="x, mm", ylabel="y, mm")


def _depth_mm(surface: Surface) -> NDArray[np.float64]:
    """(rows, cols) how far each marker is pressed in, mm; 0 where missing or raised."""
    return np.nan_to_num(np.maximum(-surface.displacement[..., 2], 0.0)) * 1e3


def _draw_solid(axes: Any, surface: Surface, scale: Normalize) -> None:
    x, y, z = np.moveaxis(surface.position * 1e3, -1, 0)
    rest = np.moveaxis(surface.reference * 1e3, -1, 0)
    depth = _depth_mm(surface)
    faces = (depth[:-1, :-1] + depth[1:, :-1] + depth[:-1, 1:] + depth[1:, 1:]) / 4
    colours = style.DEPTH_MAP(scale(faces))
    axes.computed_zorder = False
    axes.plot_surface(
        x, y, z, facecolors=colours, rstride=1, cstride=1, shade=True, edgecolor=style.INK, lw=0.25
    )
    axes.plot_wireframe(*rest, color=style.MUTED, lw=0.7, alpha=0.7, rstride=3, cstride=3)
    spans = [np.nanmax(item) - np.nanmin(item) for item in (rest[0], rest[1])]
    heights = np.concatenate([z.ravel(), rest[2].ravel()])
    spans.append((np.nanmax(heights) - np.nanmin(heights)) * EXAGGERATION)
    axes.set_box_aspect(spans, zoom=0.95)
    axes.view_init(**VIEW_DEG)
    axes.set(xlabel="x, mm", ylabel="y, mm", zlabel="z, mm")
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.pane.set_visible(False)
        axis.line.set_color(style.MUTED)
    axes.zaxis.set_major_locator(style.few_ticks(4))


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
    style.colour_bar(image, [axes], "pressed in, mm", location="left", shrink=0.85)
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
