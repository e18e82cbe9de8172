"""Figure: the force on the gel, as pressure, shear and their resultant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
from numpy.typing import NDArray

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.results import DemoResults
from cmp_tactile_processing.force_field import ForceField

__all__ = [
    "ForceScale",
    "draw_force",
    "draw_tangential",
    "force_figure",
    "force_scale",
    "node_pressure_kpa",
]

LONGEST_ARROW_PITCHES = 1.8
# Share of the shear in contact that is smaller than what the key shows.
ARROW_SHARE = 0.9


@dataclass(frozen=True)
class ForceScale:
    """One scale for all frames of a recording, whatever grid their forces are on.

    pressure: kPa.  longest_shear: kPa, drawn as an arrow of longest_arrow_mm.
    """

    pressure: Normalize
    longest_shear: float
    longest_arrow_mm: float


def force_figure(results: DemoResults, index: int) -> Figure:
    """Pressure in colour and tangential force as arrows, as measured and as they truly are."""
    fields = {
        "Measured": results.frame(index).force,
        "True": results.recording.true_force(index),
    }
    scale = force_scale(results, *fields.values())
    half_width_mm = _half_width_mm(results.frame(index).force)
    figure = style.new_figure(12.4, 11.6)
    rows = figure.subplots(2, 2, sharex=True, sharey=True)
    for (name, force), (pressure, shear) in zip(fields.items(), rows, strict=True):
        _draw_row(pressure, shear, force, scale)
        normal, tangential = -force.wrench[2], float(np.hypot(*force.wrench[:2]))
        style.title(
            pressure, f"{name} pressure, frame {index}", f"Resultant: {normal:.2f} N into the gel"
        )
        area = f"contact {force.contact_area * 1e6:.0f} mm²"
        style.title(
            shear,
            f"{name} tangential force in the contact",
            f"Resultant: {tangential:.2f} N along the gel; {area}",
        )
        for axes in (pressure, shear):
            axes.set(xlim=(-half_width_mm, half_width_mm), ylim=(-half_width_mm, half_width_mm))
    bar = figure.colorbar(
        ScalarMappable(scale.pressure, style.PRESSURE_MAP), ax=rows, shrink=0.6, pad=0.02
    )
    bar.set_label("normal pressure, kPa")
    bar.outline.set_visible(False)
    handles, labels = rows[0][1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def _draw_row(pressure: Axes, shear: Axes, force: ForceField, scale: ForceScale) -> None:
    draw_force(pressure, force, scale)
    draw_force(shear, force, scale)
    arrows = draw_tangential(shear, force, scale)
    key_kpa = float(f"{scale.longest_shear:.0e}")
    shear.quiverkey(arrows, 0.78, 0.06, key_kpa, f"{key_kpa:g} kPa", labelpos="E", labelsep=0.08)
    shear.set_ylabel("")


def _half_width_mm(force: ForceField) -> float:
    return float(np.abs(force.position[:, :2]).max()) * 1e3


def force_scale(results: DemoResults, *others: ForceField) -> ForceScale:
    """The scale that holds the pressure and shear of the recording, and of other fields too."""
    forces = [frame.force for frame in results.frames]
    highest = [np.nanmax(node_pressure_kpa(force), initial=0.1) for force in (*forces, *others)]
    shear = np.concatenate([_shear_kpa(force) for force in forces])
    longest = max(_most_kpa(values) for values in (shear, *map(_shear_kpa, others)))
    pitch_mm = float(np.diff(_node_axes(forces[0])[0]).mean()) * 1e3
    return ForceScale(
        Normalize(0.0, float(max(highest))), longest, LONGEST_ARROW_PITCHES * pitch_mm
    )


def node_pressure_kpa(force: ForceField) -> NDArray[np.float64]:
    """(rows, cols) normal force over the area that each node stands for, kPa; a press is > 0."""
    return -force.force[:, 2].reshape(force.rows, force.cols) / _node_area(force) * 1e-3


def draw_force(axes: Axes, force: ForceField, scale: ForceScale) -> None:
    """Pressure in colour, contact outline and centre of pressure; mm."""
    x, y = (axis * 1e3 for axis in _node_axes(force))
    pressure = np.nan_to_num(node_pressure_kpa(force))
    axes.pcolormesh(x, y, pressure, cmap=style.PRESSURE_MAP, norm=scale.pressure, shading="gouraud")
    contact = force.contact.reshape(force.rows, force.cols)
    if contact.any():
        axes.contour(x, y, contact, levels=[0.5], colors=style.SERIES[0], linewidths=2)
        axes.plot([], [], color=style.SERIES[0], lw=2, label="contact outline")
        axes.plot(
            *force.centre_of_pressure[:2] * 1e3,
            marker="P",
            ms=12,
            mfc="white",
            mec=style.INK,
            mew=1.4,
            ls="none",
            label="centre of pressure",
        )
    axes.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")


def draw_tangential(axes: Axes, force: ForceField, scale: ForceScale) -> Quiver:
    """Tangential force of the object on the gel over the area, in the contact: arrows."""
    shear = _shear_kpa(force)
    x_mm, y_mm = force.position[force.contact, :2].T * 1e3
    return axes.quiver(
        x_mm,
        y_mm,
        shear[:, 0],
        shear[:, 1],
        angles="xy",
        scale_units="xy",
        scale=scale.longest_shear / scale.longest_arrow_mm,
        width=0.003,
        color=style.INK,
        zorder=3,
        minlength=0.0,
    )


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


def _node_axes(force: ForceField) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x of the columns and y of the rows of the node grid, m."""
    position = force.position.reshape(force.rows, force.cols, 3)
    return position[0, :, 0], position[:, 0, 1]
