"""Plots of the last seconds of one sensor: forces with error bands, slip, latency, rate."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from cmp_tactile_viewer.scene.history import History

RGB = tuple[int, int, int]
Dash = tuple[int, ...]
# Okabe and Ito's colours, which the colour-blind tell apart; the lines differ in dashes as well.
FORCES: tuple[tuple[str, str, str, RGB, Dash], ...] = (
    ("fx", "std_x", "Fx", (0, 114, 178), ()),
    ("fy", "std_y", "Fy", (230, 159, 0), (8, 4)),
    ("fz", "std_z", "Fz", (0, 158, 115), (2, 2)),
)
# One quantity a plot; latency means something for a sensor that runs.
QUANTITIES: tuple[tuple[str, float, str, RGB, bool], ...] = (
    ("slip_ratio", 100.0, "Slip ratio, %", (213, 94, 0), False),
    ("latency_ms", 1.0, "Latency, ms", (204, 121, 167), True),
    ("rate_hz", 1.0, "Rate, Hz", (90, 90, 90), False),
)
# Height of a plot of one quantity, by that of the forces.
LOW = 0.55
CONTACT_COLOUR = (86, 180, 233)
TIME_AXIS_PX, TICK_SPACE_PX, DOT_PX = 30, 24, 3
PADDING_PX = (10, 14, 0, 0)
BANDS_SIGMA = 2.0
LEGEND_STYLE = "font-size:0.8em;display:flex;flex-wrap:wrap;gap:0 0.9em;padding:0 0.6em"
# A contact fills the lowest part of its plot.
CONTACT_SCALE = (0.0, 14.0)
# Ends of the y axis: at least so far apart, and so much of that beyond the values.
LEAST_SPAN, MARGIN, LEAST_LENGTH_S = 0.02, 0.08, 0.5

Ends = tuple[float, float]
Window = dict[str, NDArray[np.float64]]
Columns = tuple[NDArray[np.float64], ...]


class Plots:
    """Forces, and one plot for each other quantity, of a window of a history."""

    def __init__(self, gui: viser.GuiApi, height_px: int, *, is_live: bool) -> None:
        empty = History().window(1.0)
        lines = [_line(label, colour, dash) for _, _, label, colour, dash in FORCES]
        limits = [uplot.Series(label=f"{label} {end}", width=0) for label in "xyz" for end in "+-"]
        contact = uplot.Series(
            label="contact", scale="contact", width=0, fill=_css(CONTACT_COLOUR, 0.8)
        )
        gui.add_html(_legend("Force, N", [*FORCES, ("", "", "contact", CONTACT_COLOUR, ())]))
        self._forces = gui.add_uplot(
            _force_data(empty),
            series=(uplot.Series(label="s"), *lines, *limits, contact),
            bands=_bands(),
            **_common(height_px),
        )
        self._others = []
        for name, factor, label, colour, only_live in QUANTITIES:
            if is_live or not only_live:
                gui.add_html(_legend(label, ()))
                plot = gui.add_uplot(
                    (empty["time_s"], empty[name]),
                    series=(uplot.Series(label="s"), _dots(label, colour)),
                    **_common(round(LOW * height_px)),
                )
                self._others.append((plot, name, factor))

    def draw(self, history: History, length_s: float, back_s: float) -> None:
        """Show the part of a history that `History.window` gives."""
        window = history.window(length_s, back_s)
        times = _times(window["time_s"])
        data = _force_data(window)
        self._forces.scales = _scales(times, _ends(np.concatenate(data[1:-1])))
        self._forces.data = data
        for plot, name, factor in self._others:
            values = factor * window[name]
            plot.scales = _scales(times, _ends(values))
            plot.data = (window["time_s"], values)


def _common(height_px: int) -> dict[str, Any]:
    grid = uplot.Axis_Grid(stroke="#dddddd", width=1)
    return {
        "scales": _scales((0.0, 1.0), (0.0, 1.0)),
        "axes": (
            uplot.Axis(grid=grid, size=TIME_AXIS_PX),
            uplot.Axis(grid=grid, scale="y", size=46, space=TICK_SPACE_PX),
        ),
        "height": height_px,
        "padding": PADDING_PX,
        "legend": uplot.Legend(show=False),
    }


def _scales(times: Ends, ends: Ends) -> dict[str, uplot.Scale]:
    """uPlot would find no ends where a value is NaN, and leave the plot empty."""
    return {
        "x": uplot.Scale(time=False, auto=False, range=times),
        "y": uplot.Scale(auto=False, range=ends),
        "contact": uplot.Scale(auto=False, range=CONTACT_SCALE),
    }


def _times(times: NDArray[np.float64]) -> Ends:
    return float(times[0]), max(float(times[-1]), float(times[0]) + LEAST_LENGTH_S)


def _ends(values: NDArray[np.float64]) -> Ends:
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    margin = max((LEAST_SPAN - (high - low)) / 2, MARGIN * (high - low))
    return low - margin, high + margin


def _css(colour: RGB, opacity: float = 1.0) -> str:
    return f"rgba({','.join(map(str, colour))},{opacity:g})"


def _line(label: str, colour: RGB, dash: Dash) -> uplot.Series:
    return uplot.Series(label=label, stroke=_css(colour), width=2, dash=dash)


def _dots(label: str, colour: RGB) -> uplot.Series:
    """A line would join what lies before and after an unknown value: uPlot draws NaN so."""
    points = uplot.Series_Points(show=True, size=DOT_PX, width=0, fill=_css(colour))
    return uplot.Series(label=label, stroke=_css(colour), width=0, points=points)


def _legend(title: str, lines: Iterable[tuple[Any, Any, str, RGB, Dash]]) -> str:
    """What each line is, in its colour and dashes."""
    parts = [f"<b>{title}</b>"] if title else []
    for _, _, label, colour, dash in lines:
        style = {0: "solid", 8: "dashed"}.get(dash[0] if dash else 0, "dotted")
        parts.append(
            f'<span style="white-space:nowrap"><span style="display:inline-block;width:1.6em;'
            f'margin-right:0.3em;vertical-align:middle;border-top:3px {style} {_css(colour)}">'
            f"</span>{label}</span>"
        )
    return f'<div style="{LEGEND_STYLE}">{"".join(parts)}</div>'


def _bands() -> tuple[uplot.Band, ...]:
    first = 1 + len(FORCES)
    return tuple(
        uplot.Band(series=(first + 2 * number, first + 2 * number + 1), fill=_css(colour, 0.25))
        for number, (_, _, _, colour, _) in enumerate(FORCES)
    )


def _force_data(window: Window) -> Columns:
    limits: list[NDArray[np.float64]] = []
    for name, deviation, *_ in FORCES:
        half = BANDS_SIGMA * window[deviation]
        limits += [window[name] + half, window[name] - half]
    lines = (window[name] for name, *_ in FORCES)
    return (window["time_s"], *lines, *limits, window["contact"])
