"""Style of the figures: each method has one colour, marker and line in all figures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, distinguished also by colour-blind readers and on a grey print, where
# markers and lines help.
LOOKS = {
    "cmp": ("#0072B2", "o", "-"),
    "cmp_paper": ("#56B4E9", "s", "--"),
    "dmp_nearest": ("#D55E00", "^", "-"),
    "dmp_assignment": ("#009E73", "P", "-."),
    "dmp_grid": ("#E69F00", "D", "--"),
    "dmp_flow": ("#CC79A7", "v", ":"),
}
TRUE_COLOUR, PAPER_COLOUR = "#000000", "#777777"
WIDTH_IN = 9.0
STYLE: Any = {
    "backend": "Agg",
    "figure.constrained_layout.use": True,
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#dddddd",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.markersize": 5.0,
    "image.interpolation": "nearest",
}


def panels(rows: int, columns: int, height: float, **options: Any) -> tuple[Figure, Any]:
    """A new figure of the page's width, height in inches, and its axes; options of `subplots`."""
    import matplotlib as mpl
    import matplotlib.pyplot as plt

    mpl.use("Agg")
    mpl.rcParams.update(mpl.rcParamsDefault)
    mpl.rcParams.update(STYLE)
    return plt.subplots(rows, columns, figsize=(WIDTH_IN, height), **options)


def look(method: str, *, hollow: bool = False) -> dict[str, Any]:
    """Colour, line and marker of a method, by its key."""
    colour, marker, line = LOOKS[method]
    face = "white" if hollow else colour
    return {"color": colour, "marker": marker, "linestyle": line, "markerfacecolor": face}


def legend(
    figure: Figure, axes: Axes, columns: int, place: Literal["lower", "upper"] = "lower"
) -> None:
    """Name the lines of one panel for all, below the panels or in the "upper" margin."""
    handles, labels = axes.get_legend_handles_labels()
    margin: Any = f"outside {place} center"
    figure.legend(handles, labels, loc=margin, ncols=columns)
