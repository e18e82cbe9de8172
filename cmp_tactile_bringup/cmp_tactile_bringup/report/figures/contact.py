"""Figures: how the gel has moved, from above and in 3-D, and the force on it where it is now."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
from numpy.typing import NDArray

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.evaluation import BAND, DemoResults, FrameResult
from cmp_tactile_processing.measured import ForceField, Surface
from cmp_tactile_processing.surface.dense import DenseStatus, HeightMap, height_map, interpolate

EXAGGERATION = 3.0
EDGE_MM = 0.3
VIEW_DEG = {"elev": 32.0, "azim": -62.0}
# Nodes to a checker, and how far beyond the outermost markers, in checkers.
NODES_PER_PITCH, MARGIN_PITCHES = 10, 0.5
CONTOURS_MM = 0.1
# Height over width of the section.
SECTION_SHAPE = 0.7
# Around the measured nodes: the true contact may reach beyond them.
MARGIN_MM = 0.5
LONGEST_ARROW_PITCHES = 1.8
# Share of the shear in contact that is smaller than what the key shows.
ARROW_SHARE = 0.9


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


@dataclass(frozen=True)
class ForceScale:
    """One scale for all frames of a recording, whatever grid their forces are on.

    pressure: kPa.  longest_shear: kPa, drawn as an arrow of longest_arrow_mm.
    """

    pressure: Normalize
    longest_shear: float
    longest_arrow_mm: float


def force_figure(results: DemoResults, index: int) -> Figure:
    """Pressure in colour and tangential force as arrows, as measured and as they truly are.

    Both are drawn where the gel has moved to, and the true edge of the contact over both.
    """
    frame, true_force = results.frame(index), results.recording.true_force(index)
    true = _Drawn(true_force, _true_places(results, index, true_force))
    drawn = {"Measured": _Drawn(frame.force, measured_places(frame)), "True": true}
    scale = force_scale(results, frame.force, true_force)
    half_width_mm = float(np.abs(drawn["Measured"].places).max()) + MARGIN_MM
    figure = style.new_figure(12.4, 11.6)
    rows = figure.subplots(2, 2, sharex=True, sharey=True)
    for (name, item), (pressure, shear) in zip(drawn.items(), rows, strict=True):
        _draw_row(pressure, shear, item, scale)
        _name_row(pressure, shear, f"{name} {{}}, frame {index}", item.force)
        _name_peak(pressure, item.force, true_force)
        for axes in (pressure, shear):
            _draw_true_edge(axes, true)
            axes.set(xlim=(-half_width_mm, half_width_mm), ylim=(-half_width_mm, half_width_mm))
    pressures = ScalarMappable(scale.pressure, style.PRESSURE_MAP)
    style.colour_bar(pressures, list(rows.flat), "normal pressure, kPa", shrink=0.6)
    handles, labels = rows[0][1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


@dataclass(frozen=True)
class _Drawn:
    """A force field and where its nodes are drawn, (rows, cols, 2) mm."""

    force: ForceField
    places: NDArray[np.float64]


def _name_row(pressure: Axes, shear: Axes, name: str, force: ForceField) -> None:
    normal, tangential = -force.wrench[2], float(np.hypot(*force.wrench[:2]))
    std = BAND * force.wrench_std[2]
    spread = f" ± {std:.2f}" if np.isfinite(std) else ""
    style.title(
        pressure, name.format("pressure"), f"Resultant: {normal:.2f}{spread} N into the gel"
    )
    area = f"contact {force.contact_area * 1e6:.0f} mm²"
    style.title(
        shear,
        name.format("tangential force"),
        f"Resultant: {tangential:.2f} N along the gel; {area}",
    )


def _name_peak(axes: Axes, force: ForceField, true: ForceField) -> None:
    """How high the peak of the pressure is, and how far from the true one: smoothing lowers it."""
    peak, true_peak = (np.nanmax(_node_pressure_kpa(item), initial=0.0) for item in (force, true))
    words = f"Peak: {peak:.3g} kPa"
    if force is not true and true_peak > 0 and np.isfinite(force.wrench[2]):
        lower = 1 - peak / true_peak
        side = "below the true one: smoothed" if lower > 0 else "above the true one"
        words += f", {abs(lower):.0%} {side}"
    axes.annotate(words, (0.02, 0.98), xycoords="axes fraction", va="top", fontsize=10)


def _draw_true_edge(axes: Axes, true: _Drawn) -> None:
    """Around the nodes that truly touch, half-way to those that do not."""
    touching = true.force.contact.reshape(true.force.rows, true.force.cols)
    if touching.any():
        x, y = np.moveaxis(true.places, -1, 0)
        axes.contour(x, y, touching, levels=[0.5], colors="black", linewidths=1.2, linestyles=":")
        axes.plot([], [], color="black", lw=1.2, ls=":", label="true edge of the contact")


def _draw_row(pressure: Axes, shear: Axes, item: _Drawn, scale: ForceScale) -> None:
    draw_force(pressure, item.force, item.places, scale)
    draw_force(shear, item.force, item.places, scale)
    arrows = draw_tangential(shear, item.force, item.places, scale)
    key_kpa = float(f"{scale.longest_shear:.0e}")
    shear.quiverkey(arrows, 0.78, 0.06, key_kpa, f"{key_kpa:g} kPa", labelpos="E", labelsep=0.08)
    shear.set_ylabel("")


def force_scale(results: DemoResults, *others: ForceField) -> ForceScale:
    """The scale that holds the pressure and shear of the recording, and of other fields too."""
    forces = [frame.force for frame in results.frames]
    highest = [np.nanmax(_node_pressure_kpa(force), initial=0.1) for force in (*forces, *others)]
    shear = np.concatenate([_shear_kpa(force) for force in forces])
    longest = max(_most_kpa(values) for values in (shear, *map(_shear_kpa, others)))
    pitch_mm = float(np.diff(_node_axes(forces[0])[0]).mean()) * 1e3
    return ForceScale(
        Normalize(0.0, float(max(highest))), longest, LONGEST_ARROW_PITCHES * pitch_mm
    )


def _node_pressure_kpa(force: ForceField) -> NDArray[np.float64]:
    """(rows, cols) normal force over the area that each node stands for, kPa; a press is > 0."""
    return -force.force[:, 2].reshape(force.rows, force.cols) / _node_area(force) * 1e-3


def draw_force(
    axes: Axes, force: ForceField, places: NDArray[np.float64], scale: ForceScale
) -> None:
    """Pressure in colour at the places (rows, cols, 2) of the nodes, outlines, centre; mm."""
    x, y = np.moveaxis(places, -1, 0)
    pressure = np.nan_to_num(_node_pressure_kpa(force))
    axes.pcolormesh(x, y, pressure, cmap=style.PRESSURE_MAP, norm=scale.pressure, shading="gouraud")
    for number, contact in enumerate(force.contacts):
        label = None if number else "outline of a contact"
        edge = np.concatenate([contact.outline, contact.outline[:1]])[:, :2] * 1e3
        axes.plot(*edge.T, color=style.SERIES[0], lw=2, label=label)
    for number, centre in enumerate(_centres(force)):
        axes.plot(
            *centre[:2] * 1e3,
            marker="P",
            ms=12,
            mfc="white",
            mec=style.INK,
            mew=1.4,
            ls="none",
            label=None if number else "centre of pressure",
        )
    axes.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")


def _centres(force: ForceField) -> list[NDArray[np.float64]]:
    """Of each contact, or of the whole where they are not separate."""
    centres = [contact.centre_of_pressure for contact in force.contacts]
    return [c for c in centres or [force.centre_of_pressure] if np.isfinite(c).all()]


def draw_tangential(
    axes: Axes, force: ForceField, places: NDArray[np.float64], scale: ForceScale
) -> Quiver:
    """Tangential force of the object on the gel over the area, in the contact: arrows."""
    start = places.reshape(-1, 2)[force.contact]
    kpa_per_mm = scale.longest_shear / scale.longest_arrow_mm
    look = {"width": 0.003, "color": style.INK, "zorder": 3, "minlength": 0.0}
    return style.arrows(axes, start, _shear_kpa(force), kpa_per_mm, **look)


def _most_kpa(shear: NDArray[np.float64]) -> float:
    """What ARROW_SHARE of the shear (k, 2) stays below."""
    length = np.linalg.norm(shear, axis=1)
    return float(np.nanquantile(length, ARROW_SHARE)) if length.size else 1e-3


def _shear_kpa(force: ForceField) -> NDArray[np.float64]:
    """(k, 2) tangential force over the area of each node in contact, kPa."""
    area = _node_area(force).ravel()[force.contact, None]
    return np.asarray(force.force[force.contact, :2] / area * 1e-3)


def _node_area(force: ForceField) -> NDArray[np.float64]:
    """(rows, cols) area that each node stands for, m^2."""
    x, y = _node_axes(force)
    return np.outer(np.gradient(y), np.gradient(x))


def measured_places(frame: FrameResult) -> NDArray[np.float64]:
    """x and y of the nodes of a frame's force on the deformed gel, (rows, cols, 2) mm."""
    surface = frame.surface
    return _places(frame.force, surface.reference, surface.displacement)


def _true_places(results: DemoResults, index: int, force: ForceField) -> NDArray[np.float64]:
    """The same of the true force of a frame, from the true markers."""
    corners = results.recording.truth.corners_m
    return _places(force, corners[0], corners[index] - corners[0])


def _node_axes(force: ForceField) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x of the columns and y of the rows of the node grid at rest, m."""
    position = force.position.reshape(force.rows, force.cols, 3)
    return position[0, :, 0], position[:, 0, 1]


def _places(
    force: ForceField, at_rest: NDArray[np.float64], displacement: NDArray[np.float64]
) -> NDArray[np.float64]:
    """From the markers (m, n, 3) at rest and their displacement, m; beyond them as at the edge."""
    x, y = _node_axes(force)
    rest = np.stack(np.meshgrid(x, y), axis=-1)
    # The reference of a marker that was never seen is not known; the grid is regular.
    marker_x = np.linspace(np.nanmin(at_rest[..., 0]), np.nanmax(at_rest[..., 0]), at_rest.shape[1])
    marker_y = np.linspace(np.nanmin(at_rest[..., 1]), np.nanmax(at_rest[..., 1]), at_rest.shape[0])
    moved = np.stack(
        [_at(displacement[..., k], (marker_x, marker_y), (x, y)) for k in (0, 1)], axis=-1
    )
    return (rest + np.nan_to_num(moved)) * 1e3


def _at(
    values: NDArray[np.float64],
    known_at: tuple[NDArray[np.float64], NDArray[np.float64]],
    wanted_at: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Values of a regular grid between its points, bridged where NaN; NaN where all are."""
    rows = [_bridged(known_at[0], row, wanted_at[0]) for row in values]
    return np.stack([_bridged(known_at[1], col, wanted_at[1]) for col in np.array(rows).T], axis=1)


def _bridged(
    at: NDArray[np.float64], values: NDArray[np.float64], wanted: NDArray[np.float64]
) -> NDArray[np.float64]:
    known = np.isfinite(values)
    if not known.any():
        return np.full(len(wanted), np.nan)
    return np.interp(wanted, at[known], values[known])
