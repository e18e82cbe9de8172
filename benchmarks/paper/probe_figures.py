"""Pictures of section V.C: captured depth over the sensor, and what fits gain."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from paper import figure_style
from paper.experiment import Arrays
from paper.probe import HIGH_RESPONSE, PRESSED

__all__ = ["draw_depth_and_gain", "draw_maps"]

PANELS = (
    ("cmp", "CMP, with virtual markers"),
    ("cmp_paper", "CMP, the paper's algorithm"),
    ("cmp_corners", "CMP, corners only"),
    ("dmp_nearest", "DMP, nearest dot"),
)
COLOUR_OF = {"cmp_corners": "cmp"}
WAYS = (
    ("square", "quadratic,\nsquare"),
    ("nearest", "quadratic,\nnine nearest"),
    ("dense", "dense\nsurface"),
)
LIMIT_MM = 6.0


def draw_maps(points: Arrays, path: Path) -> Path:
    """Depth of the deepest marker at each point, one panel for each method."""
    figure_style.apply()
    figure, panels = plt.subplots(
        2, 2, figsize=(figure_style.WIDTH_IN, 7.6), sharex=True, sharey=True
    )
    x, y = 1e3 * points["points"].T
    true = points["true"]
    low = 1e3 * min(float(points[f"{key}_depth"].min()) for key, _ in PANELS)
    image: Any = None
    for axes, (key, title) in zip(panels.flat, PANELS, strict=True):
        depth = points[f"{key}_depth"].mean(axis=1)
        grid_x, grid_y = 1e3 * points["corner_xy"][0].T
        axes.plot(grid_x, grid_y, ".", color="#bbbbbb", markersize=1.5)
        image = axes.scatter(x, y, c=1e3 * depth, s=130, vmin=0.95 * low, vmax=1e3 * true.max())
        high = depth >= HIGH_RESPONSE * true
        axes.scatter(x[high], y[high], s=230, facecolors="none", edgecolors="black", linewidths=1.1)
        for place in zip(x, y, 1e3 * depth, strict=True):
            axes.annotate(
                f"{place[2]:.2f}",
                place[:2],
                xytext=(0, -14),
                ha="center",
                va="center",
                textcoords="offset points",
                fontsize=6.5,
            )
        axes.set_title(
            f"{title}: {high.sum()} of {len(high)}, mean {1e3 * depth.mean():.3f} mm", fontsize=8.5
        )
        axes.set(xlim=(-LIMIT_MM, LIMIT_MM), ylim=(-LIMIT_MM, LIMIT_MM), aspect="equal")
        axes.grid(visible=False)
    for axes in panels[-1]:
        axes.set_xlabel("x, mm")
    for axes in panels[:, 0]:
        axes.set_ylabel("y, mm")
    figure.colorbar(image, ax=panels, label="depth of the deepest marker, mm", shrink=0.8)
    return figure_style.save(figure, path)


def draw_depth_and_gain(points: Arrays, path: Path) -> Path:
    """Depth over the distance to a corner; gains by method and way."""
    figure_style.apply()
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(figure_style.WIDTH_IN, 3.9), width_ratios=(1, 1.35)
    )
    _draw_depth(left, points)
    _draw_gain(right, points)
    return figure_style.save(figure, path)


def _draw_depth(axes: Axes, points: Arrays) -> None:
    away, true = 1e3 * points["corner"], points["true"]
    axes.plot(
        away, 1e3 * true, "_", color=figure_style.TRUE_COLOUR, markersize=9, label="marker surface"
    )
    for key, label in PANELS:
        depth = 1e3 * points[f"{key}_depth"].mean(axis=1)
        axes.plot(away, depth, linestyle="none", label=label, **_style(key))
    lines = {"--": HIGH_RESPONSE * PRESSED, ":": HIGH_RESPONSE * true.mean()}
    whose = {"--": "60 % of the probe's", ":": "60 % of the marker surface's"}
    for line, depth in lines.items():
        axes.axhline(
            1e3 * depth,
            linestyle=line,
            linewidth=1,
            color=figure_style.PAPER_COLOUR,
            label=whose[line],
        )
    axes.set(xlabel="from the point to the nearest corner, mm", ylabel="deepest marker, mm")
    axes.set_ylim(bottom=0)
    axes.set_xlim(left=0)
    axes.legend(fontsize=7.5, loc="lower left")


def _draw_gain(axes: Axes, points: Arrays) -> None:
    for place, (way, _) in enumerate(WAYS):
        for number, (key, _) in enumerate(PANELS):
            depth = points[f"{key}_depth"]
            gains = 1e3 * (points[f"{key}_{way}"] - depth).mean(axis=1)
            wanted = 1e3 * (points["true"] - depth.mean(axis=1)).mean()
            at = place + 0.17 * (number - 1.5)
            style = _style(key)
            small = {**style, "linestyle": "none", "markersize": 3, "alpha": 0.5}
            axes.plot(np.full(len(gains), at), gains, **small)
            ends = [at - 0.055, at + 0.055]
            axes.plot(ends, [gains.mean()] * 2, linewidth=3, color=style["color"])
            axes.plot(ends, [wanted] * 2, color="black", linewidth=1)
    axes.axhline(0.0, color=figure_style.PAPER_COLOUR, linewidth=1)
    axes.set_xticks(range(len(WAYS)), [label for _, label in WAYS])
    axes.grid(visible=False, axis="x")
    axes.set_ylabel("gain over the deepest marker, mm")


def _style(key: str) -> dict[str, Any]:
    colour = COLOUR_OF.get(key, key)
    hollow = key in COLOUR_OF
    return {
        "color": figure_style.COLOURS[colour],
        "marker": figure_style.MARKERS[colour],
        "markerfacecolor": "white" if hollow else figure_style.COLOURS[colour],
    }
