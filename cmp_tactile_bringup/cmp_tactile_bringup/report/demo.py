"""The page of a demonstration: figures, numbers, and no need of another file."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.evaluation import BAND
from cmp_tactile_bringup.report.results import DemoResults, FrameResult, TableRow
from cmp_tactile_bringup.terminal import RESULT_HEADINGS
from cmp_tactile_processing.force.advice import SLIP_WORDS
from cmp_tactile_processing.measured import ForceField, SlipState, Surface, gridline_points

MARGIN_PX = 45
# Of markers, so that arrows do not overlap.
ARROW_STEP = 2
LONGEST_ARROW_MM = 1.2
AXES = ("x", "y", "z")
STATES = (SlipState.NO_CONTACT, SlipState.STICK, SlipState.INCIPIENT, SlipState.FULL)
TIME_LABEL = "time of the recording, s; stripes: phases of the motion, named at the top"
MEASURED, TRUE = style.SERIES[0], style.MUTED
Panel = Callable[[Axes, DemoResults], None]


def write_report(results: DemoResults, rows: Sequence[TableRow], folder: Path) -> Path:
    """Write PNG figures and index.html into the folder; returns the page's path."""
    folder.mkdir(parents=True, exist_ok=True)
    strongest = max(results.frames, key=_normal)
    figures = {
        "overview": overview_figure(strongest),
        "wrench": wrench_figure(results),
        "contacts": contact_figure(results),
    }
    pictures = {}
    for name, figure in figures.items():
        picture = style.save_figure(figure, folder / f"{name}.png").read_bytes()
        pictures[name] = f"data:image/png;base64,{base64.b64encode(picture).decode('ascii')}"
    values = {
        "results": results,
        "headings": RESULT_HEADINGS,
        "rows": rows,
        "pictures": pictures,
        "felt": _felt(strongest, results),
    }
    return style.write_page(folder / "index.html", "demo.html.jinja", **values)


def _normal(frame: FrameResult) -> float:
    return float(np.nan_to_num(-frame.force.wrench[2]))


def _felt(frame: FrameResult, results: DemoResults) -> dict[str, Any]:
    """What the sensor felt in the frame of the strongest press."""
    moved_mm = frame.surface.displacement * 1e3
    wrench, true = frame.force.wrench, results.recording.truth.wrench[frame.index]
    band = BAND * frame.force.wrench_std[2]
    return {
        "frame": frame.index,
        "time_s": (frame.stamp_ns - results.recording.truth.stamp_ns[0]) * 1e-9,
        "depth_mm": -np.nanmin(moved_mm[..., 2]),
        "drag_mm": np.nanmax(np.linalg.norm(moved_mm[..., :2], axis=-1)),
        "normal": -wrench[2],
        "normal_band": band if np.isfinite(band) else None,
        "true_normal": -true[2],
        "tangential": np.hypot(*wrench[:2]),
        "true_tangential": np.hypot(*true[:2]),
    }


def overview_figure(frame: FrameResult) -> Figure:
    """A frame in three panels: gridlines, displacement, force."""
    figure = style.new_figure(14.0, 4.8)
    view, displacement, force = figure.subplots(1, 3, width_ratios=[1.15, 1.1, 1.1])
    displacement.set_xlabel("x, mm\narrows: displacement along the gel, to scale")
    _draw_view(view, frame)
    _draw_surface(displacement, frame.surface)
    _draw_force(force, frame)
    for axes in (displacement, force):
        axes.set_aspect("equal")
        axes.set_ylabel("y, mm")
    titles = f"left view, frame {frame.index}", "displacement and depth", "force and pressure"
    for axes, title in zip((view, displacement, force), titles, strict=True):
        axes.set_title(title)
    return figure


def _draw_view(axes: Axes, frame: FrameResult) -> None:
    axes.imshow(frame.image, cmap="gray", vmin=0, vmax=255)
    for grid in (frame.left, frame.right):
        corners, col_lines = grid.corners_frame, grid.col_lines_frame.swapaxes(0, 1)
        for lines, colour in (
            (gridline_points(corners, grid.row_lines_frame), style.ROW),
            (gridline_points(corners.swapaxes(0, 1), col_lines), style.COLUMN),
        ):
            axes.add_collection(LineCollection(list(lines), colors=colour, linewidths=0.8))
    corners = frame.left.corners_frame.reshape(-1, 2)
    low, high = np.nanmin(corners, axis=0) - MARGIN_PX, np.nanmax(corners, axis=0) + MARGIN_PX
    axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]))
    axes.set_axis_off()


def _draw_surface(axes: Axes, surface: Surface) -> None:
    """Depth in colour where the markers are now, arrows from where they were at rest; mm."""
    position, reference = surface.position * 1e3, surface.reference * 1e3
    seen = np.isfinite(position).all(axis=-1)
    depth = np.nan_to_num(np.maximum(-surface.displacement[..., 2], 0.0)) * 1e3
    levels = np.linspace(0.0, float(depth.max()) or 0.01, 41)
    x, y = position[seen][:, 0], position[seen][:, 1]
    image = axes.tricontourf(x, y, depth[seen], levels=levels, cmap=style.DEPTH_MAP)
    # By itself a bar of contours has its ticks at their levels, which are no round numbers.
    style.colour_bar(image, [axes], "depth, mm", shrink=0.8, ticks=MaxNLocator(8))
    shown = (slice(ARROW_STEP // 2, None, ARROW_STEP),) * 2
    start, moved = reference[shown][..., :2], (position - reference)[shown][..., :2]
    style.arrows(axes, start, moved, color=style.INK, width=0.004, minlength=0.0, headwidth=4.5)


def _draw_force(axes: Axes, frame: FrameResult) -> None:
    """Pressure in colour where the gel has moved to, outlines, centres, shear as arrows."""
    force, places = frame.force, _places(frame)
    pressure = np.nan_to_num(_pressure_kpa(force))
    x, y = np.moveaxis(places, -1, 0)
    image = axes.pcolormesh(x, y, pressure, cmap=style.PRESSURE_MAP, vmin=0.0, shading="gouraud")
    style.colour_bar(image, [axes], "pressure, kPa", shrink=0.8)
    for contact in force.contacts:
        edge = np.concatenate([contact.outline, contact.outline[:1]])[:, :2] * 1e3
        axes.plot(*edge.T, color=style.SERIES[0], lw=2)
    centres = [contact.centre_of_pressure for contact in force.contacts]
    for centre in centres or [force.centre_of_pressure]:
        axes.plot(*centre[:2] * 1e3, "P", ms=12, mfc="white", mec=style.INK, mew=1.4)
    start, shear = places.reshape(-1, 2)[force.contact], _shear_kpa(force)
    longest = max(float(np.linalg.norm(shear, axis=1).max(initial=0.0)), 1e-3)
    arrows = {"width": 0.003, "color": style.INK, "zorder": 3, "minlength": 0.0}
    style.arrows(axes, start, shear, longest / LONGEST_ARROW_MM, **arrows)
    scale = f"arrows: tangential force; 1 mm is {longest / LONGEST_ARROW_MM:.0f} kPa"
    axes.set_xlabel(f"x, mm\n{scale}\nblue: edge of a contact; cross: its centre of pressure")


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


def wrench_figure(results: DemoResults) -> Figure:
    """Displacement, force and moment over time, over the truth."""
    figure = style.new_figure(13.4, 8.6)
    rows = figure.subplots(3, 1, sharex=True)
    _draw_displacement(rows[0], results)
    _draw_wrench(rows[1], results, slice(0, 3), 1.0, "force, N")
    _draw_wrench(rows[2], results, slice(3, 6), 1e3, "moment, N mm")
    for axes in rows:
        axes.axhline(0, color=style.MUTED, lw=0.8, zorder=0)
    title = "Displacement of the gel; force and moment of the object on the gel"
    return _finished(figure, rows, results, title)


def _draw_displacement(axes: Axes, results: DemoResults) -> None:
    """Largest depth and largest displacement along the gel of all markers."""
    positions = results.recording.truth.corners_m
    true = (positions - positions[0]) * 1e3
    measured = np.stack([frame.surface.displacement for frame in results.frames]) * 1e3
    for part, colour, label in (
        (lambda moved: -moved[..., 2], style.INK, "depth"),
        (lambda moved: np.linalg.norm(moved[..., :2], axis=-1), style.OBJECT, "along the gel"),
    ):
        _draw_true(axes, results, _largest(part(true)), colour, "")
        _draw_line(axes, results.time_s, _largest(part(measured)), colour, label)
    axes.plot([], [], color=style.MUTED, lw=5, alpha=0.4, label="true")
    axes.set_ylabel("largest\ndisplacement, mm")


def _draw_wrench(
    axes: Axes, results: DemoResults, columns: slice, factor: float, label: str
) -> None:
    """Three components of the wrench with their error bars.  factor: from SI to the unit."""
    true = results.recording.truth.wrench[:, columns] * factor
    forces = [frame.force for frame in results.frames]
    measured = np.stack([force.wrench[columns] for force in forces]) * factor
    band = BAND * np.stack([force.wrench_std[columns] for force in forces]) * factor
    for number, name in enumerate(AXES):
        colour, values = style.SERIES[number], measured[:, number]
        _draw_true(axes, results, true[:, number], colour, "")
        _draw_line(axes, results.time_s, values, colour, f"{label[0].upper()}{name}")
        low, high = values - band[:, number], values + band[:, number]
        axes.fill_between(results.time_s, low, high, color=colour, alpha=0.15, lw=0)
    axes.plot([], [], color=style.MUTED, lw=5, alpha=0.4, label="true")
    axes.set_ylabel(label)


def _largest(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The largest of each frame (n, ...); NaN where a frame has none."""
    # Unlike nanmax, without a warning where there is nothing but NaN.
    return np.asarray(np.fmax.reduce(values.reshape(len(values), -1), axis=1))


def _draw_phases(axes: Axes, results: DemoResults, *, names: bool) -> None:
    """Shade every second phase of the recording and write the phases' names above the axes."""
    starts = [phase.first_frame for phase in results.recording.phases]
    ends = [*starts[1:], len(results.recording.truth.stamp_ns)]
    stamps = results.recording.truth.stamp_ns
    step_s = float(np.median(np.diff(stamps))) * 1e-9
    for number, phase in enumerate(results.recording.phases):
        # Half a frame early: a phase begins between the frame before it and its first.
        begin, end = ((frame - 0.5) * step_s for frame in (starts[number], ends[number]))
        if number % 2:
            axes.axvspan(begin, end, color=style.MUTED, alpha=0.1, lw=0)
        if names:
            look: dict[str, Any] = {"ha": "center", "va": "bottom", "fontsize": 10}
            axes.text(
                (begin + end) / 2, 1.03, phase.name, transform=axes.get_xaxis_transform(), **look
            )


def _draw_line(axes: Axes, time_s: np.ndarray, values: np.ndarray, colour: str, label: str) -> None:
    axes.plot(time_s, values, color=colour, label=label, lw=1.8, marker="o", ms=3)


def contact_figure(results: DemoResults) -> Figure:
    """Area of the contacts, slip and friction; panels only of what is known."""
    panels: list[tuple[float, Panel]] = [(1.0, _draw_area)]
    if _states(results).any():
        panels.append((0.6, _draw_states))
    if np.isfinite(_slip(results, "traction_ratio")).any():
        panels.append((1.2, _draw_friction))
    heights = [height for height, _ in panels]
    figure = style.new_figure(13.4, 1.2 + 2.2 * sum(heights))
    grid = figure.subplots(len(panels), 1, sharex=True, height_ratios=heights, squeeze=False)
    rows = list(grid[:, 0])
    for axes, (_, draw) in zip(rows, panels, strict=True):
        draw(axes, results)
    return _finished(figure, rows, results, "The contacts over time")


def _finished(figure: Figure, rows: Sequence[Axes], results: DemoResults, title: str) -> Figure:
    """Panels with the phases of the motion, legends and the axis of time."""
    for axes in rows:
        _draw_phases(axes, results, names=axes is rows[0])
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.4)
    rows[0].set_title(title, pad=30)
    rows[-1].set_xlabel(TIME_LABEL)
    rows[-1].set_xlim(results.time_s[0] - 0.01, results.time_s[-1] + 0.01)
    figure.align_ylabels()
    return figure


def _draw_area(axes: Axes, results: DemoResults) -> None:
    area = np.array([frame.force.contact_area for frame in results.frames])
    _draw_true(axes, results, results.recording.truth.contact_area * 1e6)
    _draw_line(axes, results.time_s, area * 1e6, MEASURED, "measured")
    axes.set_ylabel("area, mm²")
    axes.set_ylim(bottom=0)


def _draw_states(axes: Axes, results: DemoResults) -> None:
    """Whether the contact slips; gaps where that is not known."""
    true, measured = (
        np.where(states == SlipState.UNKNOWN, np.nan, states)
        for states in (true_states(results), _states(results))
    )
    _draw_true(axes, results, true)
    _draw_line(axes, results.time_s, measured, MEASURED, "measured")
    axes.set_yticks(list(STATES), [SLIP_WORDS[state] for state in STATES])
    axes.set_ylim(min(STATES) - 0.4, max(STATES) + 0.4)


def true_states(results: DemoResults) -> NDArray[np.int64]:
    """What is true of each frame by the sensor's rule, by which a rim may slide a little."""
    truth = results.recording.truth
    states = truth.slip_state.astype(np.int64)
    little = truth.slip_ratio < results.sensor.slip.incipient_ratio
    states[(states == SlipState.INCIPIENT) & little] = SlipState.STICK
    return states


def _draw_friction(axes: Axes, results: DemoResults) -> None:
    truth = results.recording.truth
    ratio, name = _slip(results, "traction_ratio"), "tangential over normal force"
    _draw_true(axes, results, truth.traction_ratio, style.SERIES[0], f"{name}, true")
    _draw_line(axes, results.time_s, ratio, MEASURED, f"{name}, measured")
    coefficient, std = _slip(results, "friction_coefficient"), _slip(results, "friction_std")
    colour = style.SERIES[1]
    _draw_true(axes, results, truth.friction_coefficient, colour, "friction coefficient, true")
    known = np.isfinite(coefficient)
    if known.any():
        axes.errorbar(
            results.time_s[known],
            coefficient[known],
            yerr=BAND * np.nan_to_num(std[known]),
            color=colour,
            marker="o",
            ms=4,
            ls="none",
            capsize=3,
            label=f"friction coefficient, measured, ±{BAND:g} std",
        )
    axes.set_ylabel("tangential / normal")
    finite = [v[np.isfinite(v)] for v in (truth.friction_coefficient, coefficient)]
    highest = max([1.0, *np.concatenate([*finite, ratio[np.isfinite(ratio)]]).tolist()])
    axes.set_ylim(0, min(1.1 * highest, 2.5))


def _draw_true(
    axes: Axes,
    results: DemoResults,
    values: NDArray[np.float64],
    colour: str = TRUE,
    label: str = "true",
) -> None:
    """A broad line of what is true, where the recording has it."""
    if np.isfinite(values).any():
        axes.plot(_truth_s(results), values, color=colour, lw=5, alpha=0.35, label=label or None)


def _truth_s(results: DemoResults) -> NDArray[np.float64]:
    stamps = results.recording.truth.stamp_ns
    return (stamps - stamps[0]).astype(np.float64) * 1e-9


def _slip(results: DemoResults, figure: str) -> NDArray[np.float64]:
    return np.array([getattr(frame.force.slip, figure) for frame in results.frames], np.float64)


def _states(results: DemoResults) -> NDArray[np.int64]:
    """Slip state of each frame, but 0 throughout where it only separates contact from none."""
    states = np.array([frame.force.slip_state for frame in results.frames], np.int64)
    known = np.isin(states, (SlipState.STICK, SlipState.INCIPIENT, SlipState.FULL)).any()
    return states if known else np.zeros_like(states)
