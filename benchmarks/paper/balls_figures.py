"""The picture of section V.B: by how much fitted spheres differ from the balls."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from paper import figure_style
from paper.ball_fits import BallFits
from paper.reading_names import name_of
from paper.readings import Reading

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_fits"]

# Methods beside each other at one ball, over this width, mm.
SPREAD_MM = 0.55


def draw_fits(
    fits: Mapping[Reading, BallFits], exact: tuple[BallFits, BallFits], path: Path
) -> Path:
    """Deviation from the ball, from what exact markers give, and RMS of the fits.

    exact: with virtual markers and of corners alone.
    """
    import matplotlib.pyplot as plt

    figure_style.apply()
    size = figure_style.WIDTH_IN, 0.75 * figure_style.WIDTH_IN
    figure, axes = plt.subplots(3, 1, figsize=size, sharex=True, height_ratios=(1.3, 1.1, 0.9))
    ball_mm = 1e3 * exact[0].ball
    for offset, (reading, fit) in zip(np.linspace(-0.5, 0.5, len(fits)), fits.items(), strict=True):
        at = ball_mm + SPREAD_MM * offset
        look = _look(reading)
        share = 100 / fit.ball[:, None]
        _bars(axes[0], at, share * fit.from_ball, {**look, "label": name_of(reading)})
        _bars(axes[1], at, share * fit.from_exact, look)
        _bars(axes[2], at, 1e6 * fit.rms, look)
    for truth, style, label in zip(
        exact, ("-", ":"), ("exact markers, virtual ones included", "exact corners"), strict=True
    ):
        deviation = 100 * np.nanmean(truth.from_ball, axis=1) / truth.ball
        axes[0].plot(ball_mm, deviation, style, color=figure_style.TRUE_COLOUR, label=label)
    for axis in axes[:2]:
        axis.axhline(0, color=figure_style.PAPER_COLOUR, linewidth=0.8)
    axes[0].set_ylabel("fitted - ball,\n% of the ball")
    axes[1].set_ylabel("fitted - fit to exact\nmarkers, % of the ball")
    axes[2].set_ylabel("RMS distance of\nmarkers, um")
    axes[2].set_ylim(bottom=0)
    axes[2].set_xticks(ball_mm)
    axes[2].set_xlabel("diameter of the ball, mm")
    figure.legend(loc="outside lower center", ncols=3)
    return figure_style.save(figure, path)


def _look(reading: Reading) -> dict[str, Any]:
    method = "cmp" if reading.method is None else reading.method.key
    dots = reading.method is not None and reading.method.pattern_type == "dmp"
    return {
        "color": figure_style.COLOURS[method],
        "marker": figure_style.MARKERS[method],
        "fillstyle": "none" if reading.corners_only and not dots else "full",
    }


def _bars(
    axis: Axes, at: NDArray[np.float64], values: NDArray[np.float64], look: Mapping[str, Any]
) -> None:
    """Mean over the presses of each ball, and their standard deviation as a bar."""
    axis.errorbar(
        at,
        np.nanmean(values, axis=1),
        np.nanstd(values, axis=1),
        linestyle="none",
        markersize=4,
        elinewidth=1,
        **look,
    )
