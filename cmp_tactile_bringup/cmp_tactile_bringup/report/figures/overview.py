"""A frame in three panels: gridlines, displacement, force; one picture, and an animation of all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from scipy.interpolate import RegularGridInterpolator

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.results import DemoResults, FrameResult
from cmp_tactile_processing.measured import ForceField, Surface, gridline_points

WIDTH, HEIGHT = 10.0, 3.3
# Slower than life, so that the knock can be followed by eye.
MILLISECONDS_PER_FRAME = 80
QUALITY = 55
EDGE_MM, MARGIN_PX = 0.3, 45
# Of markers, so that arrows do not overlap.
ARROW_STEP = 2
LONGEST_ARROW_PITCHES = 1.8
# Share of the shear in contact that is smaller than the longest arrow.
ARROW_SHARE = 0.9
_CONTACT_WORDS = "blue: edge of a contact; cross: its centre of pressure"


@dataclass(frozen=True)
class _Scales:
    """What all pictures share, so that they can be compared.

    depth: mm.  pressure: kPa.  shear: kPa to a mm of an arrow.  half_width: of the gel, mm.
    window: low and high corner (2, 2) of the part of the frame in which the left grid is, px.
    """

    depth: Normalize
    pressure: Normalize
    shear: float
    half_width: float
    window: NDArray[np.float64]

    @classmethod
    def from_results(cls, results: DemoResults) -> _Scales:
        frames, forces = results.frames, [frame.force for frame in results.frames]
        corners = np.concatenate([frame.left.corners_frame.reshape(-1, 2) for frame in frames])
        low, high = np.nanmin(corners, axis=0) - MARGIN_PX, np.nanmax(corners, axis=0) + MARGIN_PX
        shear = np.linalg.norm(np.concatenate([_shear_kpa(force) for force in forces]), axis=1)
        pitch_mm = float(np.diff(_node_axes(forces[0])[0]).mean()) * 1e3
        longest = float(np.nanquantile(shear, ARROW_SHARE)) if shear.size else 1e-3
        pressures = [np.nanmax(_pressure_kpa(force), initial=0.1) for force in forces]
        return cls(
            depth=Normalize(0.0, max(float(_depth_mm(f.surface).max()) for f in frames) or 0.01),
            pressure=Normalize(0.0, float(max(pressures))),
            shear=longest / (LONGEST_ARROW_PITCHES * pitch_mm),
            half_width=float(np.nanmax(np.abs(results.positions[..., :2]))) * 1e3 + EDGE_MM,
            window=np.stack([low, high]),
        )


def overview_figure(results: DemoResults, index: int) -> Figure:
    """One picture of the animation, larger."""
    figure = style.new_figure(WIDTH * 1.4, HEIGHT * 1.4)
    scales = _Scales.from_results(results)
    _draw_panels(_panels(figure, scales), results.frame(index), scales)
    return figure


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


def _pictures(results: DemoResults, on_frame: Callable[[], None]) -> Iterator[Image.Image]:
    figure = style.new_figure(WIDTH, HEIGHT)
    scales = _Scales.from_results(results)
    panels = _panels(figure, scales)
    for frame in results.frames:
        for axes in panels:
            # The ticks stay, which take longer to make than all the rest.
            for artist in (*axes.collections, *axes.images, *axes.lines):
                artist.remove()
        _draw_panels(panels, frame, scales)
        if frame is results.frames[0]:
            # The layout of the first picture is kept: panels must not jump about.
            figure.draw_without_rendering()
            figure.set_layout_engine("none")
        figure.canvas.draw()
        pixels = np.asarray(figure.canvas.buffer_rgba())  # type: ignore[attr-defined]
        yield Image.fromarray(pixels).convert("RGB")
        on_frame()


def _panels(figure: Figure, scales: _Scales) -> list[Axes]:
    """The axes of view, displacement and force, with all that is the same in every frame."""
    panels = list(figure.subplots(1, 3, width_ratios=[1.15, 1.1, 1.1]))
    _, displacement, force = panels
    limits = (-scales.half_width, scales.half_width)
    for axes, words in (
        (displacement, "arrows: displacement along the gel, to scale"),
        (force, f"arrows: tangential force; 1 mm is {scales.shear:.0f} kPa\n{_CONTACT_WORDS}"),
    ):
        axes.set(xlim=limits, ylim=limits, aspect="equal")
        axes.tick_params(labelsize=8)
        axes.set_xlabel(f"x, mm\n{words}", fontsize=8, labelpad=1)
        axes.set_ylabel("y, mm", fontsize=8, labelpad=1)
    for axes, norm, colours, words in (
        (displacement, scales.depth, style.DEPTH_MAP, "depth, mm"),
        (force, scales.pressure, style.PRESSURE_MAP, "pressure, kPa"),
    ):
        bar = style.colour_bar(ScalarMappable(norm, colours), [axes], words, shrink=0.8)
        bar.ax.yaxis.label.set_fontsize(8)
        bar.ax.tick_params(labelsize=8)
    return panels


def _draw_panels(panels: Sequence[Axes], frame: FrameResult, scales: _Scales) -> None:
    view, displacement, force = panels
    _draw_view(view, frame, scales.window)
    _draw_displacement(displacement, frame.surface, scales)
    _draw_force(force, frame, scales)
    titles = f"left view, frame {frame.index}", "displacement and depth", "force and pressure"
    for axes, title in zip(panels, titles, strict=True):
        axes.set_title(title, fontsize=10, y=1.0)


def _draw_view(axes: Axes, frame: FrameResult, window: NDArray[np.float64]) -> None:
    axes.imshow(frame.image, cmap="gray", vmin=0, vmax=255)
    for grid in (frame.left, frame.right):
        corners, col_lines = grid.corners_frame, grid.col_lines_frame.swapaxes(0, 1)
        for lines, colour in (
            (gridline_points(corners, grid.row_lines_frame), style.ROW),
            (gridline_points(corners.swapaxes(0, 1), col_lines), style.COLUMN),
        ):
            axes.add_collection(LineCollection(list(lines), colors=colour, linewidths=0.8))
    axes.set(xlim=window[:, 0], ylim=window[::-1, 1])
    axes.set_axis_off()


def _draw_displacement(axes: Axes, surface: Surface, scales: _Scales) -> None:
    """Depth in colour where the markers are now, arrows from where they were at rest; mm."""
    position, reference = surface.position * 1e3, surface.reference * 1e3
    seen = np.isfinite(position).all(axis=-1)
    axes.tricontourf(
        position[seen][:, 0],
        position[seen][:, 1],
        _depth_mm(surface)[seen],
        levels=np.linspace(0.0, scales.depth.vmax or 1.0, 41),
        cmap=style.DEPTH_MAP,
        norm=scales.depth,
        extend="both",
    )
    shown = (slice(ARROW_STEP // 2, None, ARROW_STEP),) * 2
    start, moved = reference[shown][..., :2], (position - reference)[shown][..., :2]
    style.arrows(axes, start, moved, color=style.INK, width=0.004, minlength=0.0, headwidth=4.5)


def _depth_mm(surface: Surface) -> NDArray[np.float64]:
    """(rows, cols) how far each marker is pressed in, mm; 0 where missing or raised."""
    return np.nan_to_num(np.maximum(-surface.displacement[..., 2], 0.0)) * 1e3


def _draw_force(axes: Axes, frame: FrameResult, scales: _Scales) -> None:
    """Pressure in colour where the gel has moved to, outlines, centres, shear as arrows."""
    force, places = frame.force, _places(frame)
    pressure = np.nan_to_num(_pressure_kpa(force))
    x, y = np.moveaxis(places, -1, 0)
    axes.pcolormesh(
        x, y, pressure, cmap=style.PRESSURE_MAP, norm=scales.pressure, shading="gouraud"
    )
    for contact in force.contacts:
        edge = np.concatenate([contact.outline, contact.outline[:1]])[:, :2] * 1e3
        axes.plot(*edge.T, color=style.SERIES[0], lw=2)
    centres = [contact.centre_of_pressure for contact in force.contacts]
    for centre in centres or [force.centre_of_pressure]:
        axes.plot(*centre[:2] * 1e3, "P", ms=12, mfc="white", mec=style.INK, mew=1.4)
    start = places.reshape(-1, 2)[force.contact]
    arrows = {"width": 0.003, "color": style.INK, "zorder": 3, "minlength": 0.0}
    style.arrows(axes, start, _shear_kpa(force), scales.shear, **arrows)


def _pressure_kpa(force: ForceField) -> NDArray[np.float64]:
    """(rows, cols) normal force over the area that each node stands for, kPa; a press is > 0."""
    return -force.force[:, 2].reshape(force.rows, force.cols) / _node_area(force) * 1e-3


def _shear_kpa(force: ForceField) -> NDArray[np.float64]:
    """(k, 2) tangential force over the area of each node in contact, kPa."""
    area = _node_area(force).ravel()[force.contact, None]
    return np.asarray(force.force[force.contact, :2] / area * 1e-3)


def _node_area(force: ForceField) -> NDArray[np.float64]:
    """(rows, cols) area that each node stands for, m^2."""
    x, y = _node_axes(force)
    return np.outer(np.gradient(y), np.gradient(x))


def _node_axes(force: ForceField) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x of the columns and y of the rows of the node grid at rest, m."""
    position = force.position.reshape(force.rows, force.cols, 3)
    return position[0, :, 0], position[:, 0, 1]


def _places(frame: FrameResult) -> NDArray[np.float64]:
    """Where nodes are on the deformed gel, (rows, cols, 2) mm; beyond markers as at the edge."""
    at_rest, moved = frame.surface.reference, frame.surface.displacement[..., :2]
    rows, cols = at_rest.shape[:2]
    # The reference of a marker that was never seen is not known; the grid is regular.
    marker_x = np.linspace(np.nanmin(at_rest[..., 0]), np.nanmax(at_rest[..., 0]), cols)
    marker_y = np.linspace(np.nanmin(at_rest[..., 1]), np.nanmax(at_rest[..., 1]), rows)
    rest = np.stack(np.meshgrid(*_node_axes(frame.force)), axis=-1)
    low, high = (marker_x[0], marker_y[0]), (marker_x[-1], marker_y[-1])
    of_markers = RegularGridInterpolator((marker_y, marker_x), np.nan_to_num(moved))
    return np.asarray(rest + of_markers(rest.clip(low, high)[..., ::-1])) * 1e3
