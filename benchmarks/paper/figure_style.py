"""How figures look: one colour and marker for each method, whatever the figure."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Okabe and Ito's colours, distinguished also by colour-blind readers and on a grey print, where
# markers and line styles help.
COLOURS = {
    "cmp": "#0072B2",
    "cmp_paper": "#56B4E9",
    "dmp_nearest": "#D55E00",
    "dmp_assignment": "#009E73",
    "dmp_grid": "#E69F00",
    "dmp_flow": "#CC79A7",
}
MARKERS = {
    "cmp": "o",
    "cmp_paper": "s",
    "dmp_nearest": "^",
    "dmp_assignment": "P",
    "dmp_grid": "D",
    "dmp_flow": "v",
}
LINES = {
    "cmp": "-",
    "cmp_paper": "--",
    "dmp_nearest": "-",
    "dmp_assignment": "-.",
    "dmp_grid": "--",
    "dmp_flow": ":",
}
TRUE_COLOUR = "#000000"
PAPER_COLOUR = "#777777"

WIDTH_IN = 9.0
DOTS_PER_INCH = 110


def apply() -> None:
    """Set matplotlib to draw into files in this style; call it before a figure is made."""
    import matplotlib as mpl
    from cycler import cycler

    mpl.use("Agg")
    mpl.rcParams.update(mpl.rcParamsDefault)
    mpl.rcParams.update(
        {
            "backend": "Agg",
            "figure.figsize": (WIDTH_IN, 0.45 * WIDTH_IN),
            "figure.dpi": DOTS_PER_INCH,
            "savefig.dpi": DOTS_PER_INCH,
            "figure.constrained_layout.use": True,
            "font.family": "DejaVu Sans",
            "font.size": 9.0,
            "axes.titlesize": 10.0,
            "axes.labelsize": 9.0,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.grid": True,
            "axes.axisbelow": True,
            "axes.prop_cycle": cycler(color=list(COLOURS.values())),
            "grid.color": "#dddddd",
            "grid.linewidth": 0.6,
            "legend.frameon": False,
            "legend.fontsize": 8.5,
            "lines.linewidth": 1.5,
            "lines.markersize": 5.0,
            "image.cmap": "viridis",
            "image.interpolation": "nearest",
        }
    )


def blank(height: float) -> Figure:
    """A new figure in this style, of the page's width; height in inches."""
    import matplotlib.pyplot as plt

    apply()
    return plt.figure(figsize=(WIDTH_IN, height))


def panels(rows: int, columns: int, height: float, **options: Any) -> tuple[Figure, Any]:
    """A new figure in this style and its axes; options as of `matplotlib.pyplot.subplots`."""
    import matplotlib.pyplot as plt

    apply()
    return plt.subplots(rows, columns, figsize=(WIDTH_IN, height), **options)


def look(method: str) -> dict[str, Any]:
    """Colour, line and marker of a method, by its key."""
    return {"color": COLOURS[method], "linestyle": LINES[method], "marker": MARKERS[method]}


def legend(
    figure: Figure, axes: Axes, columns: int, place: Literal["lower", "upper"] = "lower"
) -> None:
    """Name the lines of one panel for all, below the panels or in the "upper" margin."""
    handles, labels = axes.get_legend_handles_labels()
    margin: Any = f"outside {place} center"
    figure.legend(handles, labels, loc=margin, ncols=columns)


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG, close it, and return the path.

    The same figure gives the same bytes: the file names no date and no version.
    """
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format="png", metadata={"Software": None})
    plt.close(figure)
    return path
