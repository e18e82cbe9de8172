"""Pictures of IV.D: error maps, and errors by what they may come from."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from paper import figure_style
from paper.dot_methods import ALL_METHODS, DMP_NEAREST
from paper.experiment import Arrays, Results
from paper.film import DOT_DIAMETER
from paper.marker_errors import root_mean_square
from paper.method import CMP, Method
from paper.precision import DOT_SIZES, NOISE, SHARPER
from paper.precision_figures import AXES, split_of, summary_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["error_maps", "error_sources"]

SPHERE_MM = 15.0
ERROR_COLOURS = "RdBu_r"


def error_maps(told: Arrays, phase: int, path: Path) -> Path:
    """As Fig. 11 (d, e): CMP above, DMP below, a column for each axis."""
    import matplotlib.pyplot as plt

    figure_style.apply()
    methods = (CMP, DMP_NEAREST)
    maps = {method.key: told[f"{method.key}_errors"][0, phase] * 1e6 for method in methods}
    figure, axes = plt.subplots(
        2, 3, sharex=True, sharey=True, figsize=(figure_style.WIDTH_IN, 5.6), squeeze=False
    )
    reference = told["reference"][..., :2] * 1e3
    for k, name in enumerate(AXES):
        widest = float(np.nanmax([np.abs(map_[..., k]) for map_ in maps.values()]))
        for row, method in enumerate(methods):
            axis = axes[row, k]
            error = maps[method.key][..., k]
            drawn = axis.pcolormesh(
                reference[0, :, 0],
                reference[:, 0, 1],
                error,
                cmap=ERROR_COLOURS,
                vmin=-widest,
                vmax=widest,
                shading="nearest",
            )
            _outline(axis, told, phase)
            rms = root_mean_square(error[..., None].repeat(3, axis=-1))[0]
            axis.set_title(f"{method.label}: {name}, RMS {rms:.2g} um", fontsize=9)
            axis.set_aspect("equal")
            axis.grid(visible=False)
            if row:
                axis.set_xlabel("x [mm]")
            if k == 0:
                axis.set_ylabel("y [mm]")
        figure.colorbar(drawn, ax=axes[:, k], label=f"error in {name} [um]", shrink=0.8)
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
    axes[0, 0].set_ylabel("RMS displacement error in space [um]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure_style.save(figure, path)


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
    radii = [radius for radius, _, _ in contacts]
    for method in ALL_METHODS:
        clean = [split_of(arrays, method, phase).systematic for _, arrays, phase in contacts]
        noisy = [summary_of(arrays, method, phase).space for _, arrays, phase in contacts]
        style = _style(method)
        axis.loglog(radii, np.array(noisy) * 1e6, label=method.label, **style)
        axis.loglog(radii, np.array(clean) * 1e6, **style, markerfacecolor="none", alpha=0.7)
    axis.invert_xaxis()
    axis.set_xticks(radii, [f"{radius:g}" for radius in radii])
    axis.minorticks_off()
    axis.set_xlabel("smallest radius of the object [mm], sharper to the right")
    axis.set_title("by curvature (open: without noise)")


def _draw_noise(axis: Axes, results: Results) -> None:
    told = results["noise"]
    for method in ALL_METHODS:
        rms = [np.linalg.norm(root_mean_square(errors)) for errors in told[method.key]]
        axis.semilogy(NOISE, np.array(rms) * 1e6, **_style(method))
    axis.set_xlabel("noise [grey levels]")
    axis.set_title("by noise, all loads")


def _draw_dots(axis: Axes, results: Results) -> None:
    told = results["dots"]
    style = _style(DMP_NEAREST)
    for key, face in (("errors", style["color"]), ("clean", "none")):
        rms = [np.linalg.norm(root_mean_square(errors)) for errors in told[key]]
        axis.semilogy(DOT_SIZES, np.array(rms) * 1e6, **style, markerfacecolor=face)
    axis.axvline(DOT_DIAMETER, color=figure_style.PAPER_COLOUR, linestyle=":")
    axis.set_xlabel("dot diameter / pitch")
    axis.set_title("by dot size (open: without noise)")


def _style(method: Method) -> dict[str, str]:
    return {
        "color": figure_style.COLOURS[method.key],
        "linestyle": figure_style.LINES[method.key],
        "marker": figure_style.MARKERS[method.key],
    }
