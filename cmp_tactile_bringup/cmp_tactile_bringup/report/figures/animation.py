"""A short animation: camera frames, displacement and wrench side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from PIL import Image

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.evaluation import DemoResults, FrameResult
from cmp_tactile_bringup.report.figures.force import (
    ForceScale,
    draw_force,
    draw_tangential,
    force_scale,
    measured_places,
)
from cmp_tactile_bringup.report.figures.markers import Window, draw_frame, left_view_window
from cmp_tactile_bringup.report.figures.surface import depth_scale, draw_displacement

WIDTH, HEIGHT = 9.0, 3.1
# Slower than life, so that the knock can be followed by eye.
MILLISECONDS_PER_FRAME = 80
QUALITY = 55
EDGE_MM = 0.3


@dataclass(frozen=True)
class _Scales:
    """What all pictures share, so that they can be compared."""

    depth: Normalize
    force: ForceScale
    half_width_mm: float
    window: Window


def write_animation(
    results: DemoResults, path: Path, on_frame: Callable[[], None] = lambda: None
) -> Path:
    """Write all frames as an animated WebP that repeats without end."""
    pictures = list(_pictures(results, on_frame))
    pictures[0].save(
        path,
        save_all=True,
        append_images=pictures[1:],
        duration=MILLISECONDS_PER_FRAME,
        loop=0,
        quality=QUALITY,
        method=2,
    )
    return path


def overview_figure(results: DemoResults, index: int) -> Figure:
    """One picture of the animation, larger."""
    figure = style.new_figure(WIDTH * 1.4, HEIGHT * 1.4)
    _draw_panels(_panels(figure), results.frame(index), _scales(results))
    return figure


def _pictures(results: DemoResults, on_frame: Callable[[], None]) -> Iterator[Image.Image]:
    figure = style.new_figure(WIDTH, HEIGHT)
    panels, scales = _panels(figure), _scales(results)
    for frame in results.frames:
        for axes in panels:
            _wipe(axes)
        _draw_panels(panels, frame, scales)
        if frame is results.frames[0]:
            # The layout of the first picture is kept: panels must not jump about.
            figure.draw_without_rendering()
            figure.set_layout_engine("none")
        yield _render(figure)
        on_frame()


def _panels(figure: Figure) -> list[Axes]:
    return list(figure.subplots(1, 3, width_ratios=[1.05, 1, 1]))


def _scales(results: DemoResults) -> _Scales:
    half_width_mm = float(np.nanmax(np.abs(results.positions[..., :2]))) * 1e3 + EDGE_MM
    window = left_view_window(results.frames)
    return _Scales(depth_scale(results), force_scale(results), half_width_mm, window)


def _draw_panels(panels: Sequence[Axes], frame: FrameResult, scales: _Scales) -> None:
    view, displacement, force = panels
    draw_frame(view, frame, line_width=0.8)
    left, right, top, bottom = scales.window
    view.set(xlim=(left, right), ylim=(bottom, top))
    _title(view, f"left view, frame {frame.index}")
    draw_displacement(displacement, frame.surface, scales.depth, arrow_step=2)
    places = measured_places(frame)
    draw_force(force, frame.force, places, scales.force)
    draw_tangential(force, frame.force, places, scales.force)
    _title(displacement, "displacement and depth")
    _title(force, "force and pressure")
    for axes in (displacement, force):
        axes.set(
            xlim=(-scales.half_width_mm, scales.half_width_mm),
            ylim=(-scales.half_width_mm, scales.half_width_mm),
            xlabel="",
            ylabel="",
        )
        axes.tick_params(labelsize=8)
        axes.set_xlabel("mm", fontsize=8, labelpad=1)


def _wipe(axes: Axes) -> None:
    """Remove what was drawn but keep the ticks, which take longer to make than all the rest."""
    for artist in (*axes.collections, *axes.images, *axes.lines):
        artist.remove()


def _title(axes: Axes, text: str) -> None:
    axes.set_title(text, fontsize=10, y=1.0)


def _render(figure: Figure) -> Image.Image:
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())  # type: ignore[attr-defined]
    return Image.fromarray(pixels).convert("RGB")
