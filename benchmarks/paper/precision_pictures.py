"""Pictures of IV.D: error maps, and errors by what they may come from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from paper import figure_style
from paper.dot_methods import DMP_GRID
from paper.experiment import Arrays, Results
from paper.film import DOT_DIAMETER
from paper.marker_errors import root_mean_square
from paper.method import CMP, Method
from paper.precision import DMP_PLAIN, DOT_SIZES, METHODS, NOISE, SHARPER
from paper.precision_figures import AXES, split_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["error_maps", "error_sources"]

SPHERE_MM = 15.0
_SHORT = {CMP.key: "CMP", DMP_PLAIN.key: "DMP, plain"}
ERROR_COLOURS = "RdBu_r"


def error_maps(told: Arrays, phase: int, path: Path) -> Path:
    """As Fig. 11 (d, e), a column for each axis; below them the means over draws."""
    import matplotlib.pyplot as plt

    figure_style.apply()
    rows = _rows_of_maps(told, phase)
    figure, axes = plt.subplots(
        len(rows), 3, sharex=True, sharey=True, figsize=(figure_style.WIDTH_IN, 10.6), squeeze=False
    )
    places = told["reference"][0, :, 0] * 1e3, told["reference"][:, 0, 1] * 1e3
    for k, name in enumerate(AXES):
        widest = float(np.nanmax([np.abs(errors[..., k]) for _, errors in rows]))
        scale = {"cmap": ERROR_COLOURS, "vmin": -widest, "vmax": widest, "shading": "nearest"}
        for row, (label, errors) in enumerate(rows):
            axis = axes[row, k]
            drawn = axis.pcolormesh(*places, errors[..., k], **scale)
            _outline(axis, told, phase)
            axis.set_title(f"{name}: RMS {root_mean_square(errors)[k]:.2f} um", fontsize=9)
            axis.set_aspect("equal")
            axis.grid(visible=False)
            if k == 0:
                axis.set_ylabel(f"{label}\ny [mm]")
        axes[-1, k].set_xlabel("x [mm]")
        bar = figure.colorbar(drawn, ax=axes[:, k], location="bottom", shrink=0.9, pad=0.02)
        bar.set_label(f"error in {name} [um]")
    return figure_style.save(figure, path)


def error_sources(results: Results, path: Path) -> Path:
    """RMS error in space by curvature of the object, and by noise and dot size where known."""
    import matplotlib.pyplot as plt

    figure_style.apply()
    panels = [_draw_curvature]
    panels += [_draw_noise] if "noise" in results else []
    panels += [_draw_dots] if "dots" in results else []
    figure, axes = plt.subplots(
        1, len(panels), figsize=(figure_style.WIDTH_IN, 3.7), squeeze=False, sharey=False
    )
    for axis, draw in zip(axes[0], panels, strict=True):
        draw(axis, results)
        axis.set_ylim(bottom=0)
    axes[0, 0].set_ylabel("RMS displacement error in space [um]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure_style.save(figure, path)


def _rows_of_maps(told: Arrays, phase: int) -> list[tuple[str, NDArray[np.float64]]]:
    """Labels, and errors (rows, cols, 3) in um."""
    rows = []
    for method in (CMP, DMP_PLAIN):
        errors = np.asarray(told[f"{method.key}_errors"][:, phase], dtype=np.float64) * 1e6
        rows.append((f"{_SHORT[method.key]}, one draw", errors[0]))
        rows.append((f"{_SHORT[method.key]}, mean of {len(errors)}", errors.mean(axis=0)))
    return [rows[0], rows[2], rows[1], rows[3]]


def _outline(axis: Axes, told: Arrays, phase: int) -> None:
    """Border of the nodes in contact, which lie on a regular grid."""
    x, y = (np.unique(np.round(told["node"][:, k], 9)) for k in (0, 1))
    field = np.zeros((len(y), len(x)))
    col = np.searchsorted(x, np.round(told["node"][:, 0], 9))
    row = np.searchsorted(y, np.round(told["node"][:, 1], 9))
    field[row, col] = told["contact"][phase]
    axis.contour(x * 1e3, y * 1e3, field, levels=[0.5], colors="black", linewidths=1.2)


def _draw_curvature(axis: Axes, results: Results) -> None:
    told: Arrays = {**results["loads_cmp"], **results["loads_dmp"]}
    contacts = [(SPHERE_MM, told, len(told["phase"]) - 1)]
    contacts += [(radius, results[name], 0) for name, radius in SHARPER.items() if name in results]
    for method in METHODS:
        of_contacts = [arrays[f"{method.key}_errors"][:, phase] for _, arrays, phase in contacts]
        _draw_both(axis, method, np.arange(float(len(contacts))), of_contacts)
    axis.set_xticks(np.arange(len(contacts)), [f"{radius:g}" for radius, _, _ in contacts])
    axis.set_xlabel("smallest radius of the object [mm]")
    axis.set_title("by curvature, sharper to the right")


def _draw_noise(axis: Axes, results: Results) -> None:
    told = results["noise"]
    for method in METHODS:
        rms = [np.linalg.norm(root_mean_square(errors)) for errors in told[method.key]]
        axis.plot(NOISE, np.array(rms) * 1e6, **_style(method))
    axis.set_xlabel("noise [grey levels]")
    axis.set_title("by noise, all loads")


def _draw_dots(axis: Axes, results: Results) -> None:
    told = results["dots"]
    for method, centres in ((DMP_GRID, "corrected"), (DMP_PLAIN, "plain")):
        errors = [told[f"{size:g}_{centres}_errors"][:, 0] for size in DOT_SIZES]
        _draw_both(axis, method, np.array(DOT_SIZES), errors)
    axis.axvline(DOT_DIAMETER, color=figure_style.PAPER_COLOUR, linestyle=":")
    axis.set_xlabel("dot diameter / pitch")
    axis.set_title("by dot size, all loads")


def _draw_both(
    axis: Axes, method: Method, x: NDArray[np.float64], errors: Sequence[NDArray[np.float64]]
) -> None:
    """RMS in space of errors (draws, rows, cols, 3), filled, and its systematic part, open."""
    both = [np.linalg.norm(root_mean_square(each)) for each in errors]
    systematic = [split_of(each).systematic for each in errors]
    style = _style(method)
    axis.plot(x, np.array(both) * 1e6, label=method.label, **style)
    style["linestyle"] = "none"
    axis.plot(x, np.array(systematic) * 1e6, **style, markerfacecolor="none")


def _style(method: Method) -> dict[str, Any]:
    if method is DMP_PLAIN:
        return {"color": "#333333", "linestyle": "-.", "marker": "x"}
    return {
        "color": figure_style.COLOURS[method.key],
        "linestyle": figure_style.LINES[method.key],
        "marker": figure_style.MARKERS[method.key],
    }
