"""The sweep's figure: which checkers a camera should see."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cmp_tactile_processing.printing.advice import LEAST_SIDE_PX, RECOMMENDED_SIDE_PX
from paper.figure_style import PAPER_COLOUR, WIDTH_IN, apply, save
from paper.pattern_choice_results import Cell, by_width

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_answer", "draw_lights"]

# From dark to light by resolution, readable in grey, each with a marker of its own.
SHADES = ("#440154", "#3b528b", "#21918c", "#5ec962", "#d8c219")
SIGNS = ("o", "s", "^", "D", "v")
LIGHT_NAMES = {"good": "good", "dim": "dim, 4 : 1", "noisy": "noise of 10", "soft": "soft lens"}
PAPER_WIDTH, PAPER_CORNERS = 1024, 20
MICRO = 1e6
# The band's ends over the size recommended.
BAND = (0.88, 1.25)
ERRORS_SHOWN = (0.5, 1, 2, 3, 5, 10, 20, 30)
SIDES_SHOWN = (3, 5, 8, 14, 25, 50)


def draw_answer(cells: Sequence[Cell], path: Path) -> Path:
    """Error of the field over the checkers' side, for each resolution, and virtual markers."""
    import matplotlib.pyplot as plt

    apply()
    figure, axes = plt.subplots(1, 3, figsize=(WIDTH_IN, 0.5 * WIDTH_IN), width_ratios=(3, 3, 2.4))
    _draw_sides(axes[0], cells, Cell.fine, "fine: eleven beads of 1.2 mm")
    _draw_sides(axes[1], cells, Cell.smooth, "smooth: a ball presses, drags 1.1 mm")
    axes[1].set_ylabel("")
    figure.legend(
        *axes[0].get_legend_handles_labels(), title="image, px", loc="outside upper left", ncols=6
    )
    _draw_points(axes[2], [cell for cell in cells if cell.width == PAPER_WIDTH])
    # Room for the right one's legend.
    low = 0.5 * min(axis.get_ylim()[0] for axis in axes)
    high = max(axis.get_ylim()[1] for axis in axes)
    for axis in axes:
        axis.set_ylim(low, high)
    return save(figure, path)


def draw_lights(cells: Sequence[Cell], path: Path) -> Path:
    """The same in worse light, and the markers that are lost."""
    import matplotlib.pyplot as plt

    apply()
    figure, axes = plt.subplots(1, 2, figsize=(WIDTH_IN, 0.4 * WIDTH_IN))
    standard = [cell for cell in cells if cell.width == PAPER_WIDTH]
    for (light, name), shade, sign in zip(LIGHT_NAMES.items(), SHADES, SIGNS, strict=False):
        sides = [cell.side_least for cell in standard]
        errors = [MICRO * cell.fine(light) for cell in standard]
        axes[0].plot(sides, errors, sign + "-", color=shade, label=name)
        sides = [cell.side_least for cell in cells]
        lost = [100 * cell.lost_share(light) for cell in cells]
        axes[1].plot(sides, lost, sign, color=shade, label=name, alpha=0.7)
    _side_axis(axes[0])
    _side_axis(axes[1])
    _error_axis(axes[0])
    axes[0].set_ylabel("error of the field, beads, RMS, µm")
    axes[0].set_title(f"image of {PAPER_WIDTH} px")
    axes[1].set_ylabel("markers lost, %")
    axes[1].set_yscale("symlog", linthresh=0.1)
    axes[1].set_ylim(-0.03, 150)
    shares = (0, 0.1, 1, 10, 100)
    axes[1].set_yticks(shares, [f"{share:g}" for share in shares])
    axes[1].set_title("all resolutions and deformations")
    axes[0].legend(title="light")
    return save(figure, path)


def _draw_sides(
    axes: Axes, cells: Sequence[Cell], error: Callable[[Cell], float], title: str
) -> None:
    for (width, group), shade, sign in zip(by_width(cells).items(), SHADES, SIGNS, strict=False):
        sides = [cell.side_least for cell in group]
        errors = [MICRO * error(cell) for cell in group]
        axes.plot(sides, errors, sign + "-", color=shade, label=f"{width} x {width * 3 // 4}")
    for cell in cells:
        if (cell.width, cell.corners) == (PAPER_WIDTH, PAPER_CORNERS):
            axes.plot(
                [cell.side_least],
                [MICRO * error(cell)],
                "*",
                color=PAPER_COLOUR,
                markersize=15,
                markeredgecolor="white",
                zorder=5,
                label="paper's prototype",
            )
    _error_axis(axes)
    _side_axis(axes)
    axes.set_ylabel("error of the field between markers, RMS, µm")
    axes.set_title(title)


def _draw_points(axes: Axes, cells: Sequence[Cell]) -> None:
    swept = [cell for cell in cells if len(cell.field) > 2]
    for cell, shade, sign in zip(swept or list(cells)[:5], SHADES, SIGNS, strict=False):
        points = sorted(cell.field)
        errors = [MICRO * cell.fine(points=count) for count in points]
        name = f"{cell.corners} x {cell.corners}, {cell.side_least:.0f} px"
        axes.plot(points, errors, sign + "-", color=shade, label=name)
    axes.set_xscale("symlog", linthresh=1)
    ticks = sorted({count for cell in cells for count in cell.field})
    axes.set_xticks(ticks, [str(count) for count in ticks])
    axes.xaxis.minorticks_off()
    _error_axis(axes)
    axes.set_xlabel("virtual markers in a segment")
    axes.set_title(f"fine, image of {PAPER_WIDTH} px")
    axes.legend(fontsize=7.5, loc="lower left", borderaxespad=0.1)


def _error_axis(axes: Axes) -> None:
    axes.set_yscale("log")
    axes.set_yticks(ERRORS_SHOWN, [f"{error:g}" for error in ERRORS_SHOWN])
    axes.yaxis.minorticks_off()


def _side_axis(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_xticks(SIDES_SHOWN, [str(side) for side in SIDES_SHOWN])
    axes.xaxis.minorticks_off()
    axes.set_xlabel("smallest checker in the image, px")
    low, high = np.array(BAND) * RECOMMENDED_SIDE_PX
    axes.axvspan(low, high, color="#0072B2", alpha=0.15, lw=0, zorder=0)
    axes.axvline(LEAST_SIDE_PX, color=PAPER_COLOUR, ls="--", lw=1)
