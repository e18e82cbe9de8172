"""One look for all figures and pages: fonts, colours distinct for the colour-blind, saving."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
import matplotlib as mpl
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.quiver import Quiver
from numpy.typing import NDArray

# Okabe and Ito's palette, which stays distinct for all common kinds of colour blindness.
ROW = "#56b4e9"
COLUMN = "#e69f00"
OBJECT = "#cc79a7"
SERIES = ("#0072b2", "#d55e00", "#009e73")
INK = "#1f2933"
MUTED = "#7b8794"
# Sequential from "nothing" (near white) on; cut before they grow too dark for arrows on them.
DEPTH_MAP = LinearSegmentedColormap.from_list("depth", colormaps["YlGnBu"](np.linspace(0, 0.78)))
PRESSURE_MAP = LinearSegmentedColormap.from_list(
    "pressure", colormaps["YlOrRd"](np.linspace(0, 0.82))
)
DPI = 110

STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 11,
    "axes.titlesize": 12,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 10,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "figure.facecolor": "white",
    "image.interpolation": "antialiased",
}


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of that size in inches, drawn in memory without any display."""
    # Nothing of a matplotlibrc in the current folder, which may name programs to be run.
    mpl.rcdefaults()
    mpl.rcParams.update(STYLE)  # type: ignore[arg-type]
    layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.12, wspace=0.02, hspace=0.03)
    figure = Figure(figsize=(width, height), dpi=DPI, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def title(axes: Axes, headline: str, detail: str = "") -> None:
    """A bold headline and, below it, a line of detail."""
    axes.set_title(headline, pad=26 if detail else 10)
    if detail:
        axes.annotate(
            detail,
            (0, 1),
            xytext=(0, 9),
            xycoords="axes fraction",
            textcoords="offset points",
            fontsize=10,
            color=MUTED,
        )


def arrows(
    axes: Axes,
    start: NDArray[np.float64],
    moved: NDArray[np.float64],
    scale: float = 1.0,
    **look: Any,
) -> Quiver:
    """Arrows in the units of the axes from start (..., 2) on, by moved (..., 2) over the scale."""
    parts = (*np.moveaxis(start, -1, 0), *np.moveaxis(moved, -1, 0))
    return axes.quiver(*parts, angles="xy", scale_units="xy", scale=scale, **look)


def colour_bar(image: ScalarMappable, axes: Sequence[Axes], label: str, **layout: Any) -> Colorbar:
    """A bar of colours beside the axes."""
    bar = axes[0].figure.colorbar(image, ax=axes, pad=0.02, **layout)
    bar.set_label(label)
    bar.outline.set_visible(False)
    return bar


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a PNG file."""
    figure.savefig(path, bbox_inches="tight", pad_inches=0.15)
    return path


def write_page(path: Path, template: str, **values: Any) -> Path:
    """Write an HTML page from a template of this package; texts are escaped."""
    path.write_text(_templates().get_template(template).render(values), encoding="utf-8")
    return path


@cache
def _templates() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
