"""Pictures of section IV.E: five spheres as each method sees them, and pairs told apart."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle
from numpy.typing import NDArray

from paper import figure_style
from paper.experiment import Arrays
from paper.resolution import RADIUS
from paper.two_contacts import RAYLEIGH_DIP

__all__ = ["draw_dips", "draw_spheres"]

COLUMNS = (
    ("true", "truth"),
    ("cmp", "CMP"),
    ("cmp_corners", "CMP, corners only"),
    ("dmp_nearest", "DMP, nearest dot"),
)
LINES = (
    ("cmp", "CMP, with virtual markers", "cmp", "-"),
    ("cmp_paper", "CMP, the paper's algorithm", "cmp_paper", "--"),
    ("cmp_corners", "CMP, corners only", "cmp", ":"),
    ("dmp_nearest", "DMP, nearest dot", "dmp_nearest", "-"),
    ("dmp_grid", "DMP, grid order", "dmp_grid", "--"),
    ("dmp_flow", "DMP, optical flow", "dmp_flow", ":"),
)
# The part of the print that is drawn, m, and by how much displacements are exaggerated.
SHOWN = 5.4e-3
EXAGGERATION = 4
ERROR_UM = 60.0

Array = NDArray[np.float64]


def draw_spheres(spheres: Arrays, path: Path) -> Path:
    """Three rows by method: surface with markers, depth, error."""
    figure_style.apply()
    figure = plt.figure(figsize=(figure_style.WIDTH_IN, 7.0))
    cells = figure.add_gridspec(3, len(COLUMNS), height_ratios=(1.0, 1.15, 1.3))
    true, nodes = spheres["true"], spheres["nodes"]
    deepest = 1e3 * float((-true[..., 2]).max())
    flat: list[list[Any]] = [[], []]
    images: list[Any] = [None, None]
    for place, (key, title) in enumerate(COLUMNS):
        field = true if key == "true" else spheres[f"{key}_field"]
        solid: Any = figure.add_subplot(cells[0, place], projection="3d")
        markers = [spheres["corner_xy"]] + ([spheres["virtual_xy"]] if key == "cmp" else [])
        _draw_surface(solid, nodes, field, np.concatenate(markers))
        solid.set_title(title, y=1.12)
        error = 1e6 * (true[..., 2] - field[..., 2])
        panels = (
            (-1e3 * field[..., 2], "viridis", 0.0, deepest),
            (error, "RdBu_r", -ERROR_UM, ERROR_UM),
        )
        for row, (values, colours, low, high) in enumerate(panels):
            axes = figure.add_subplot(cells[row + 1, place])
            style: dict[str, Any] = {"cmap": colours, "vmin": low, "vmax": high, "rasterized": True}
            images[row] = axes.pcolormesh(*(1e3 * nodes.transpose(2, 0, 1)), values, **style)
            _frame(axes, spheres["centres"], last=row == 1, first=place == 0)
            if row == 1 and key != "true":
                near = 1e6 * spheres[f"{key}_near"].mean()
                axes.set_title(f"RMS near spheres {near:.3g} um", fontsize=8.5)
            flat[row].append(axes)
    figure.colorbar(images[0], ax=flat[0], label="depth, mm")
    figure.colorbar(images[1], ax=flat[1], label="error of depth, um")
    return figure_style.save(figure, path)


def draw_dips(pairs: Arrays, path: Path) -> Path:
    """Dip over separation, share told apart over separation."""
    figure_style.apply()
    figure, (left, right) = plt.subplots(1, 2, figsize=(figure_style.WIDTH_IN, 3.9))
    wide = np.unique(pairs["separation"])
    wide = wide[wide > 0]
    of = [pairs["separation"] == value for value in wide]
    _draw_true_dips((left, right), 1e3 * wide, [pairs["true"][rows] for rows in of])
    for key, label, colour, line in LINES:
        style: dict[str, Any] = {
            "color": figure_style.COLOURS[colour],
            "linestyle": line,
            "marker": figure_style.MARKERS[colour],
            "label": label,
            "markerfacecolor": "white" if key == "cmp_corners" else None,
        }
        dips = [pairs[f"{key}_dip"][rows] for rows in of]
        left.plot(1e3 * wide, [100 * np.nanmean(d) for d in dips], **style)
        right.plot(1e3 * wide, [100 * (d >= RAYLEIGH_DIP).mean() for d in dips], **style)
    left.axhline(100 * RAYLEIGH_DIP, color=figure_style.PAPER_COLOUR, linestyle="--", linewidth=1)
    left.annotate(
        "told apart from here",
        (1e3 * wide[-1], 100 * RAYLEIGH_DIP),
        ha="right",
        va="bottom",
        fontsize=8,
        color=figure_style.PAPER_COLOUR,
    )
    left.set(xlabel="separation of the spheres, mm", ylabel="dip between them, %")
    right.set(xlabel="separation of the spheres, mm", ylabel="pairs told apart, %")
    right.legend(loc="lower right")
    return figure_style.save(figure, path)


def _draw_true_dips(panels: tuple[Axes, Axes], wide_mm: Array, true: list[Array]) -> None:
    """What the marker surface itself does, by separation."""
    left, right = panels
    style: dict[str, Any] = {"color": figure_style.TRUE_COLOUR}
    least, most = ([100 * end(t) for t in true] for end in (np.min, np.max))
    left.fill_between(wide_mm, least, most, alpha=0.15, linewidth=0, **style)
    style["label"] = "marker surface itself"
    left.plot(wide_mm, [100 * t.mean() for t in true], **style)
    right.plot(wide_mm, [100 * (t >= RAYLEIGH_DIP).mean() for t in true], **style)


def _draw_surface(axes: Any, nodes: Array, field: Array, marker_xy: Array) -> None:
    """The displaced surface, markers on it in blue, their displacement in red."""
    inside = np.abs(nodes[:, 0, 1]) < SHOWN
    part = np.ix_(inside, inside)
    x, y = (1e3 * nodes[part][..., axis] for axis in (0, 1))
    # What is drawn is the displacement alone, not the gel's own curvature.
    z = 1e3 * EXAGGERATION * field[part][..., 2]
    axes.plot_surface(x, y, z, color="#dddddd", linewidth=0, rstride=2, cstride=2, alpha=0.6)
    shown = marker_xy[(np.abs(marker_xy) < SHOWN).all(axis=1)]
    spacing = nodes[0, 1, 0] - nodes[0, 0, 0]
    col, row = np.rint((shown - nodes[0, 0]) / spacing).astype(int).T
    moved = 1e3 * EXAGGERATION * field[row, col]
    # Thousands of markers would hide the surface.
    size = 1.0 if len(shown) < 400 else 3.5
    begin = np.column_stack([1e3 * shown, np.zeros(len(shown))])
    # One line with gaps: thousands of single ones take seconds to draw.
    ways = np.stack([begin, begin + moved, np.full_like(begin, np.nan)], axis=1).reshape(-1, 3)
    axes.plot(*ways.T, color="#D55E00", linewidth=0.9 / size)
    axes.scatter(*(begin + moved).T, s=2.5 / size, color="#0072B2", depthshade=False)
    axes.set_box_aspect((1, 1, 0.3), zoom=1.6)
    axes.view_init(elev=42, azim=-60)
    axes.set_axis_off()


def _frame(axes: Any, centres: Array, *, last: bool, first: bool) -> None:
    for x, y in 1e3 * centres:
        axes.add_patch(Circle((x, y), 1e3 * RADIUS, fill=False, color="black", linewidth=0.7))
    limit = 1e3 * SHOWN
    axes.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal")
    axes.grid(visible=False)
    if last:
        axes.set_xlabel("x, mm")
    else:
        axes.set_xticklabels([])
    if first:
        axes.set_ylabel("y, mm")
    else:
        axes.set_yticklabels([])
