"""Pictures of section V.C: captured depth over the sensor, and what fits gain."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from paper import figure_style
from paper.experiment import Arrays
from paper.probe import HIGH_RESPONSE, PRESSED

__all__ = ["draw_depth_and_gain", "draw_maps"]

PANELS = (
    ("cmp", "CMP, virtual markers"),
    ("cmp_paper", "CMP of the paper"),
    ("cmp_corners", "CMP, corners only"),
    ("dmp_nearest", "DMP, nearest neighbour"),
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
    away, true = 1e3 * points["corner"], points["true"]
    left.plot(
        away, 1e3 * true, "_", color=figure_style.TRUE_COLOUR, markersize=9, label="marker surface"
    )
    for key, label in PANELS:
        left.plot(
            away,
            1e3 * points[f"{key}_depth"].mean(axis=1),
            linestyle="none",
            label=label,
            **_style(key),
        )
    lines = {"--": HIGH_RESPONSE * PRESSED, ":": HIGH_RESPONSE * true.mean()}
    whose = {"--": "60 % of the probe's", ":": "60 % of the marker surface's"}
    for line, depth in lines.items():
        left.axhline(
            1e3 * depth,
            linestyle=line,
            linewidth=1,
            color=figure_style.PAPER_COLOUR,
            label=whose[line],
        )
    left.set(xlabel="from the point to the nearest corner, mm", ylabel="deepest marker, mm")
    left.set_ylim(bottom=0)
    left.set_xlim(left=0)
    left.legend(fontsize=7.5, loc="lower left")
    for place, (way, _) in enumerate(WAYS):
        for number, (key, _) in enumerate(PANELS):
            gains = 1e3 * (points[f"{key}_{way}"] - points[f"{key}_depth"]).mean(axis=1)
            wanted = 1e3 * (true - points[f"{key}_depth"].mean(axis=1)).mean()
            at = place + 0.17 * (number - 1.5)
            right.plot(
                np.full(len(gains), at),
                gains,
                linestyle="none",
                **{**_style(key), "markersize": 3, "alpha": 0.5},
            )
            right.plot(
                [at - 0.055, at + 0.055],
                [gains.mean()] * 2,
                linewidth=3,
                color=_style(key)["color"],
            )
            right.plot([at - 0.055, at + 0.055], [wanted] * 2, color="black", linewidth=1)
    right.axhline(0.0, color=figure_style.PAPER_COLOUR, linewidth=1)
    right.set_xticks(range(len(WAYS)), [label for _, label in WAYS])
    right.grid(visible=False, axis="x")
    right.set_ylabel("gain over the deepest marker, mm")
    return figure_style.save(figure, path)


def _style(key: str) -> dict[str, Any]:
    colour = COLOUR_OF.get(key, key)
    hollow = key in COLOUR_OF
    return {
        "color": figure_style.COLOURS[colour],
        "marker": figure_style.MARKERS[colour],
        "markerfacecolor": "white" if hollow else figure_style.COLOURS[colour],
    }
