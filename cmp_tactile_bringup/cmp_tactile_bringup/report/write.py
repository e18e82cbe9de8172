"""The report of a demonstration: figures, animation, and a page that needs no other file."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from PIL import Image

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.evaluation import (
    BAND,
    DemoResults,
    FrameResult,
    TableRow,
    find_jump,
)
from cmp_tactile_bringup.report.figures import contact, markers
from cmp_tactile_bringup.report.figures.over_time import contact_figure, wrench_figure

WIDTH, HEIGHT = 9.0, 3.1
# Slower than life, so that the knock can be followed by eye.
MILLISECONDS_PER_FRAME = 80
QUALITY = 55
EDGE_MM = 0.3


@dataclass(frozen=True)
class _Scales:
    """What all pictures share, so that they can be compared."""

    depth: Normalize
    force: contact.ForceScale
    half_width_mm: float
    window: markers.Window


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
    window = markers.left_view_window(results.frames)
    return _Scales(
        contact.depth_scale(results), contact.force_scale(results), half_width_mm, window
    )


def _draw_panels(panels: Sequence[Axes], frame: FrameResult, scales: _Scales) -> None:
    view, displacement, force = panels
    markers.draw_frame(view, frame, line_width=0.8)
    left, right, top, bottom = scales.window
    view.set(xlim=(left, right), ylim=(bottom, top))
    _title(view, f"left view, frame {frame.index}")
    contact.draw_displacement(displacement, frame.surface, scales.depth, arrow_step=2)
    places = contact.measured_places(frame)
    contact.draw_force(force, frame.force, places, scales.force)
    contact.draw_tangential(force, frame.force, places, scales.force)
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


# The animation in one picture, for where nothing moves.
OVERVIEW = "overview.png"
# By the names of their files; captions are in the template of the page.
FIGURES: dict[str, Callable[[DemoResults, int], Figure]] = {
    "frame": markers.frame_figure,
    "displacement": contact.displacement_figure,
    "shape": contact.shape_figure,
    "knock": lambda results, _index: markers.knock_figure(results),
    "force": contact.force_figure,
    "wrench": lambda results, _index: wrench_figure(results),
    "contacts": lambda results, _index: contact_figure(results),
}


def report_steps(results: DemoResults) -> int:
    """How often `write_report` will call `on_step`."""
    return len(FIGURES) + len(results.frames) + 1


def write_report(
    results: DemoResults,
    rows: Sequence[TableRow],
    folder: Path,
    on_step: Callable[[], None] = lambda: None,
) -> Path:
    """Write PNG figures, the animation and index.html into the folder; returns the page's path.

    Raises LookupError where no two neighbouring frames came through.
    """
    folder.mkdir(parents=True, exist_ok=True)
    # Just before the largest jump: pressed and dragged at once.
    index = results.frames[find_jump(results).before].index
    paths = [write_animation(results, folder / "grasp.webp", on_step)]
    style.save_figure(overview_figure(results, index), folder / OVERVIEW)
    for name, draw in FIGURES.items():
        paths.append(style.save_figure(draw(results, index), folder / f"{name}.png"))
        on_step()
    pictures = {path.stem: _embedded(path) for path in paths}
    values = {"results": results, "rows": rows, "pictures": pictures, "felt": _felt(results)}
    page = style.write_page(folder / "index.html", "demo.html.jinja", **values)
    on_step()
    return page


def _embedded(picture: Path) -> str:
    data = base64.b64encode(picture.read_bytes()).decode("ascii")
    return f"data:image/{picture.suffix[1:]};base64,{data}"


def _felt(results: DemoResults) -> dict[str, Any]:
    """What the sensor felt just before and in the largest jump: N, mm, ms."""
    jump = find_jump(results)
    before, after = results.frames[jump.before], results.frames[jump.after]
    moved_mm = before.surface.displacement * 1e3
    jump_mm = float(np.nanmax(jump.distance)) * 1e3
    wrench, true = before.force.wrench, results.recording.truth.wrench[before.index]
    band = BAND * before.force.wrench_std[2]
    return {
        "frame": before.index,
        "time_s": results.time_s[jump.before],
        "depth_mm": -np.nanmin(moved_mm[..., 2]),
        "drag_mm": np.nanmax(np.linalg.norm(moved_mm[..., :2], axis=-1)),
        "normal": -wrench[2],
        "normal_band": band if np.isfinite(band) else None,
        "true_normal": -true[2],
        "tangential": np.hypot(*wrench[:2]),
        "true_tangential": np.hypot(*true[:2]),
        "interval_ms": (after.stamp_ns - before.stamp_ns) * 1e-6,
        "jump_mm": jump_mm,
        "jump_checkers": jump_mm * 1e-3 / results.sensor.pattern.pitch,
        "kept": int(np.isfinite(after.surface.position).all(axis=-1).sum()),
        "markers": after.surface.status.size,
    }
