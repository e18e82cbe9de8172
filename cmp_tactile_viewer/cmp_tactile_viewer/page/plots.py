"""Plots of the last seconds of one sensor: forces with error bands, slip, latency, rate."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from cmp_tactile_processing.force.advice import DOUBTS, flag_names
from cmp_tactile_viewer.snapshot import Snapshot

FIGURES = (
    "time_s", "fx", "fy", "fz", "std_x", "std_y", "std_z", "contact", "slip_ratio", "latency_ms",
    "rate_hz", "begins", "doubtful",
)  # fmt: skip
# Two minutes at 60 Hz.
CAPACITY = 7200
# A plot has no more pixels than that.
MOST_POINTS = 300
# The rate is that of so many frames.
RATE_FRAMES = 30
# A step in time is a jump if it is longer than both: s, and in median steps.
MIN_JUMP_S, MIN_JUMP_STEPS = 0.5, 5.0
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
# A doubtful force has all of its plot filled in the colour of warnings.
DOUBT_COLOUR = (230, 120, 0)
# Ends of the y axis: at least so far apart, and so much of that beyond the values.
LEAST_SPAN, MARGIN, LEAST_LENGTH_S = 0.02, 0.08, 0.5
Ends = tuple[float, float]
Window = dict[str, NDArray[np.float64]]
Columns = tuple[NDArray[np.float64], ...]


class History:
    """Keeps the figures of the last CAPACITY snapshots in a ring.

    doubts: flags for which the newest force is doubtful; empty where it is not.
    """

    def __init__(self, capacity: int = CAPACITY) -> None:
        # Each row is kept twice, a capacity apart: the newest are then always in one piece.
        self._table = np.full((2 * capacity, len(FIGURES)), np.nan)
        self._capacity = capacity
        self._count = 0
        self._begin_ns: int | None = None
        self.doubts = ""

    def add(self, snapshot: Snapshot) -> None:
        """Take a snapshot in; one that is not later than the last begins a new history.

        Times count from the earliest snapshot ever seen, also after a recording is gone back in.
        """
        if self._begin_ns is None or snapshot.stamp_ns < self._begin_ns:
            self._count, self._begin_ns = 0, snapshot.stamp_ns
        time_s = (snapshot.stamp_ns - self._begin_ns) * 1e-9
        if self._count and time_s <= self._ordered()[-1, 0]:
            self._count = 0
        row = np.full(len(FIGURES), np.nan)
        row[0] = time_s
        row[9] = 1e3 * snapshot.latency_s
        if snapshot.force is not None:
            force = snapshot.force
            row[1:4], row[4:7] = force.wrench[:3], force.wrench_std[:3]
            row[7] = 1.0 if force.contacts else 0.0
            row[8] = force.slip.slip_ratio
            self.doubts = flag_names(force.flags & DOUBTS)
            row[12] = 1.0 if force.flags & DOUBTS else 0.0
        recent = self._ordered()[-RATE_FRAMES:]
        recent = recent[_last_begin(recent) :, 0]
        row[11] = float(_is_jump(recent, time_s))
        row[10] = snapshot.rate_hz
        if np.isnan(row[10]) and len(recent) and not row[11]:
            row[10] = len(recent) / (time_s - recent[0])
        place = self._count % self._capacity
        self._table[[place, place + self._capacity]] = row
        self._count += 1

    def window(self, length_s: float, back_s: float = 0.0) -> dict[str, NDArray[np.float64]]:
        """The figures from `length_s` before the end, which lies `back_s` before the newest.

        It begins at the last jump in time at the earliest: uPlot joins points across NaN.
        No more than MOST_POINTS; one point, all NaN, where nothing is known.
        """
        rows = self._ordered()
        if not len(rows):
            rows = np.full((1, len(FIGURES)), np.nan)
            rows[0, 0] = 0.0
        end = rows[-1, 0] - back_s
        first, last = np.searchsorted(rows[:, 0], (end - length_s, end + 1e-9))
        chosen = rows[first : max(last, first + 1)]
        chosen = chosen[_last_begin(chosen) :]
        if len(chosen) > MOST_POINTS:
            chosen = chosen[np.linspace(0, len(chosen) - 1, MOST_POINTS).astype(int)]
        return dict(zip(FIGURES, np.ascontiguousarray(chosen.T), strict=True))

    def _ordered(self) -> NDArray[np.float64]:
        """The rows that are kept, the oldest first."""
        first = self._count % self._capacity if self._count > self._capacity else 0
        return self._table[first : first + min(self._count, self._capacity)]


def _is_jump(times: NDArray[np.float64], time_s: float) -> bool:
    """Whether frames are missing between the last of these times (N,) and `time_s`, all s."""
    if len(times) < 2:
        return False
    step_s = time_s - float(times[-1])
    return step_s > max(MIN_JUMP_S, MIN_JUMP_STEPS * float(np.median(np.diff(times))))


def _last_begin(rows: NDArray[np.float64]) -> int:
    """Index of the last row that follows a jump, 0 if none does."""
    return int(np.flatnonzero(rows[:, FIGURES.index("begins")] == 1.0)[-1:].sum())


class Plots:
    """Forces, and one plot for each other quantity, of a window of a history."""

    def __init__(self, gui: viser.GuiApi, height_px: int, *, is_live: bool) -> None:
        empty = History().window(1.0)
        lines = [_line(label, colour, dash) for _, _, label, colour, dash in FORCES]
        limits = [uplot.Series(label=f"{label} {end}", width=0) for label in "xyz" for end in "+-"]
        contact = uplot.Series(
            label="contact", scale="contact", width=0, fill=_css(CONTACT_COLOUR, 0.8)
        )
        doubtful = uplot.Series(
            label="doubtful", scale="contact", width=0, fill=_css(DOUBT_COLOUR, 0.25)
        )
        self._legend = gui.add_html(_force_legend(""))
        self._forces = gui.add_uplot(
            _force_data(empty),
            series=(uplot.Series(label="s"), *lines, *limits, contact, doubtful),
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
        legend = _force_legend(history.doubts)
        if legend != self._legend.content:
            self._legend.content = legend
        window = history.window(length_s, back_s)
        times = _times(window["time_s"])
        data = _force_data(window)
        self._forces.scales = _scales(times, _ends(np.concatenate(data[1:-2])))
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


def _force_legend(doubts: str) -> str:
    """With what is doubtful about the force that is shown."""
    legend = _legend("Force, N", [*FORCES, ("", "", "contact", CONTACT_COLOUR, ())])
    colour = _css(DOUBT_COLOUR)
    mark = f'<b style="color:{colour}">! {doubts}</b>' if doubts else ""
    return f'{legend}<div style="{LEGEND_STYLE}">{mark}</div>'


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
    doubtful = CONTACT_SCALE[1] * window["doubtful"]
    return (window["time_s"], *lines, *limits, window["contact"], doubtful)
