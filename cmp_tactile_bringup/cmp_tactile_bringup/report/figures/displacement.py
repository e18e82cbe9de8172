"""Figure: how far every marker has moved, from above and in 3-D."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.results import DemoResults
from cmp_tactile_processing.measured.surface import Surface

__all__ = ["depth_scale", "displacement_figure", "draw_displacement"]

EXAGGERATION = 3.0
EDGE_MM = 0.3
VIEW_DEG = {"elev": 32.0, "azim": -62.0}


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
    bar = figure.colorbar(
        ScalarMappable(scale, style.DEPTH_MAP), ax=plan, location="left", pad=0.02, shrink=0.85
    )
    bar.set_label("pressed in, mm")
    bar.outline.set_visible(False)
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
    axes.quiver(
        start[..., 0],
        start[..., 1],
        moved[..., 0],
        moved[..., 1],
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=0.0028 * arrow_step**0.5,
        color=style.INK,
        minlength=0.0,
        headwidth=4.5,
    )
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
