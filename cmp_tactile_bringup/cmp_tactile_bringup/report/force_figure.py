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
# Share of the tangential forces in contact that are smaller than what the key shows.
ARROW_SHARE = 0.9


@dataclass(frozen=True)
class ForceScale:
    """One scale for all frames of a recording: pressure in kPa, longest tangential arrow in N."""

    pressure: Normalize
    longest_arrow: float


def force_figure(results: DemoResults, index: int) -> Figure:
    """Normal pressure in colour with the contact's outline; beside it the tangential force."""
    force, scale = results.frame(index).force, force_scale(results)
    normal, tangential = -force.wrench[2], float(np.hypot(*force.wrench[:2]))
    figure = style.new_figure(12.4, 6.2)
    pressure, shear = figure.subplots(1, 2, sharey=True)
    draw_force(pressure, force, scale)
    style.title(
        pressure, f"Pressure on the gel, frame {index}", f"Resultant: {normal:.2f} N into the gel"
    )
    draw_force(shear, force, scale)
    arrows = draw_tangential(shear, force, scale)
    key = float(f"{scale.longest_arrow * 1e3:.0e}")
    shear.quiverkey(arrows, 0.8, 1.035, key, f"{key:g} mN per node", labelpos="E", labelsep=0.08)
    style.title(
        shear, "Tangential force in the contact", f"Resultant: {tangential:.2f} N along the gel"
    )
    shear.set_ylabel("")
    bar = figure.colorbar(
        ScalarMappable(scale.pressure, style.PRESSURE_MAP),
        ax=[pressure, shear],
        shrink=0.85,
        pad=0.02,
    )
    bar.set_label("normal pressure, kPa")
    bar.outline.set_visible(False)
    handles, labels = shear.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def force_scale(results: DemoResults) -> ForceScale:
    """The scale that holds the largest pressure and tangential force of the recording."""
    forces = [frame.force for frame in results.frames]
    highest = [np.nanmax(node_pressure_kpa(force), initial=0.1) for force in forces]
    in_contact = np.concatenate([force.force[force.contact, :2] for force in forces])
    tangential = np.linalg.norm(in_contact, axis=1)
    longest = float(np.nanquantile(tangential, ARROW_SHARE)) if tangential.size else 1e-3
    return ForceScale(Normalize(0.0, float(max(highest))), longest)


def node_pressure_kpa(force: ForceField) -> NDArray[np.float64]:
    """(rows, cols) normal force over the area that each node stands for, kPa; a press is > 0."""
    normal = -force.force[:, 2].reshape(force.rows, force.cols)
    x, y = _node_axes(force)
    return normal / np.outer(np.gradient(y), np.gradient(x)) * 1e-3


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
    """Tangential force of the object on the gel at the nodes in contact, as arrows."""
    tangential = force.force[force.contact, :2] * 1e3
    x_mm, y_mm = force.position[force.contact, :2].T * 1e3
    arrow_mm = LONGEST_ARROW_PITCHES * float(np.diff(_node_axes(force)[0]).mean()) * 1e3
    return axes.quiver(
        x_mm,
        y_mm,
        tangential[:, 0],
        tangential[:, 1],
        angles="xy",
        scale_units="xy",
        scale=scale.longest_arrow * 1e3 / arrow_mm,
        width=0.003,
        color=style.INK,
        zorder=3,
        minlength=0.0,
    )


def _node_axes(force: ForceField) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x of the columns and y of the rows of the node grid, m."""
    position = force.position.reshape(force.rows, force.cols, 3)
    return position[0, :, 0], position[:, 0, 1]
