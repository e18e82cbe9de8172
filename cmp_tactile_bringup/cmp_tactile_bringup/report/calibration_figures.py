"""Figures of a calibration: where its model does not meet what was measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_bringup.report import style
from cmp_tactile_processing.calibration.material.loads import LoadResult
from cmp_tactile_processing.calibration.outcome import ViewResiduals, length_text
from cmp_tactile_processing.sensor.parts import Pattern

Image = NDArray[np.uint8]
# The arrow of a typical residual is so long, as a share of the view's width.
ARROW_SHARE = 0.03
MOST_ARROWS = 4000
AXES_HEIGHT, LEAST_WIDTH, MARGIN = 5.6, 3.6, 1.0
AXES = ("Fx", "Fy", "Fz")
MARKS = ("^", "s", "o")
# Standard deviations that a bar reaches: 95 % of a normal error lies within.
BAR = 2.0
# Components below this share of the force are only shown where they were meant to be there.
LEAST_SHARE = 0.05
POINT = [
    ("axis", np.intp),
    ("used", np.bool_),
    ("known", np.float64),
    ("known_std", np.float64),
    ("before", np.float64),
    ("after", np.float64),
    ("after_std", np.float64),
]


def residual_figure(residuals: Sequence[ViewResiduals], pictures: Mapping[str, Image]) -> Figure:
    """Residuals over each view, magnified.  pictures: one image of each view, where there is."""
    shown = _shown(residuals)
    spans = [_span(item, pictures.get(item.view)) for item in shown]
    sides = [high - low for low, high in spans]
    widths = [max(AXES_HEIGHT * side[0] / side[1], LEAST_WIDTH) for side in sides]
    figure = style.new_figure(sum(widths) + MARGIN * len(shown), AXES_HEIGHT + MARGIN)
    for axes, item, span in zip(_row_of_axes(figure, len(shown)), shown, spans, strict=True):
        _draw_vectors(axes, item, span, pictures.get(item.view))
    return figure


def _span(
    item: ViewResiduals, picture: Image | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """First and last pixel (2,) that are shown."""
    if picture is None:
        return item.pixels.min(axis=0) - 10, item.pixels.max(axis=0) + 10
    return np.zeros(2), np.array(picture.shape[1::-1], np.float64)


def _draw_vectors(
    axes: Axes,
    item: ViewResiduals,
    span: tuple[NDArray[np.float64], NDArray[np.float64]],
    picture: Image | None,
) -> None:
    low, high = span
    if picture is not None:
        # Pale, so that arrows stand out.
        axes.imshow(picture, cmap="gray", vmin=-350, vmax=255)
    axes.set_xlim(low[0] - 0.5, high[0] - 0.5)
    axes.set_ylim(high[1] - 0.5, low[1] - 0.5)
    axes.set_aspect("equal")
    typical = max(item.rms, 1e-4)
    magnified = ARROW_SHARE * (high[0] - low[0]) / typical
    step = -(-len(item.pixels) // MOST_ARROWS)
    for used, colour in ((True, style.SERIES[0]), (False, style.SERIES[1])):
        chosen = np.flatnonzero(item.used == used)[::step]
        moved = item.residuals[chosen] * magnified
        style.arrows(axes, item.pixels[chosen], moved, width=0.0025, color=colour)
    left_out = int((~item.used).sum())
    more = f"; {left_out} of {len(item.used)} left out (orange)" if left_out else ""
    style.title(
        axes,
        f"{item.view} view: {item.rms:.3f} px RMS",
        f"measured minus model, {magnified:.0f} x{more}",
    )
    axes.set_xlabel("px of the view")


def truth_figure(errors: NDArray[np.float64], pattern: Pattern) -> Figure:
    """Mean distance of each marker to the truth.  errors: (frames, rows, cols) m."""
    figure = style.new_figure(6.6, 5.2)
    axes = figure.subplots()
    mean_um = np.nanmean(errors, axis=0) * 1e6
    corners, half = pattern.corners(), pattern.pitch / 2
    x, y = corners[0, :, 0], corners[:, 0, 1]
    left, right, low, up = (1e3 * v for v in (x[0] - half, x[-1] + half, y[0] - half, y[-1] + half))
    image = axes.imshow(
        mean_um,
        origin="lower",
        extent=(left, right, low, up),
        cmap=style.PRESSURE_MAP,
        vmin=0.0,
        # Few outliers are not to leave the others pale.
        vmax=max(float(np.nanpercentile(mean_um, 99)), 1e-4),
        interpolation="nearest",
    )
    axes.set_xlabel("x on the gel, mm")
    axes.set_ylabel("y, mm")
    whole = length_text(float(np.nanmean(errors)))
    detail = f"mean error of each marker against the truth; all markers: {whole}"
    style.title(axes, "3-D error", detail)
    style.colour_bar(image, [axes], "um", shrink=0.8)
    return figure


def _shown(residuals: Sequence[ViewResiduals]) -> list[ViewResiduals]:
    return [item for item in residuals if len(item.pixels)]


def _row_of_axes(figure: Figure, count: int) -> list[Axes]:
    return [figure.add_subplot(1, count, k + 1) for k in range(count)]


def material_figure(loads: Sequence[LoadResult]) -> Figure:
    """Reading against reference before and after, and what is left, for all known components."""
    figure = style.new_figure(12.0, 5.6)
    left, right = figure.subplots(1, 2)
    points = _points(loads)
    ends = [min(0.0, points.known.min(initial=0.0)), max(0.0, points.known.max(initial=0.0))]
    left.plot(ends, ends, color=style.MUTED, lw=1, zorder=0)
    right.axhline(0, color=style.MUTED, lw=1, zorder=0)
    for axis, name in enumerate(AXES):
        own = points[points.used & (points.axis == axis)]
        if not own.size:
            continue
        look: dict[str, Any] = {
            "color": style.SERIES[axis], "marker": MARKS[axis], "ls": "none", "ms": 6
        }  # fmt: skip
        left.plot(own.known, own.before, **look, fillstyle="none", label=f"{name} before")
        left.errorbar(
            own.known, own.after, BAR * own.after_std, **look, capsize=4, label=f"{name} after"
        )
        bars = BAR * np.hypot(own.after_std, own.known_std)
        right.errorbar(own.known, own.after - own.known, bars, **look, capsize=4)
    unused = points[~points.used]
    if unused.size:
        left.plot(unused.known, unused.before, "x", color=style.MUTED, label="left out")
    for axes, label in ((left, "force of the sensor, N"), (right, "sensor minus known, N")):
        axes.set_xlabel("known force, N")
        axes.set_ylabel(label)
        axes.margins(0.08)
    meaning = f"bars: {BAR:g} standard deviations"
    style.title(left, "Force of the sensor under known loads", f"{meaning}, after")
    style.title(
        right, "Remaining difference with the new material", f"{meaning} of sensor and load"
    )
    left.legend(loc="best")
    return figure


def known_components(load: LoadResult) -> NDArray[np.bool_]:
    """Which components (3,) are known, and a good part of the force."""
    known = np.isfinite(load.reference)
    size = np.linalg.norm(load.reference[known])
    return np.asarray(known & (np.abs(load.reference) >= LEAST_SHARE * size))


def _points(loads: Sequence[LoadResult]) -> Any:
    """The components that are known, of all loads: a record array (n,) of POINT."""
    points = [
        (
            axis,
            load.used,
            load.reference[axis],
            load.reference_std[axis],
            load.before[axis],
            load.after[axis],
            np.nan_to_num(load.after_std[axis]),
        )
        for load in loads
        for axis in np.flatnonzero(known_components(load))
    ]
    return np.array(points, POINT).view(np.recarray)


def relaxation_figure(
    time_s: NDArray[np.float64],
    reading: NDArray[np.float64],
    corrected: NDArray[np.float64],
    reference: NDArray[np.float64] | float | None,
) -> Figure:
    """A record (n,), N, over time: as it was read, without the relaxation, and as it is known."""
    figure = style.new_figure(11.0, 5.2)
    axes = figure.subplots()
    if reference is not None:
        # A weight is known while it is on.
        on = np.abs(reading) > 0.5 * np.nanmax(np.abs(reading))
        true = np.where(on, np.broadcast_to(reference, time_s.shape), np.nan)
        axes.plot(time_s, true, color=style.MUTED, lw=5, alpha=0.4, label="known")
    axes.plot(time_s, reading, color=style.SERIES[1], lw=1.8, label="elastic alone")
    axes.plot(time_s, corrected, color=style.SERIES[0], lw=1.8, label="relaxation removed")
    axes.set_xlabel("time, s")
    axes.set_ylabel("force into the gel, N")
    style.title(axes, "Force of the gel under a held load")
    axes.legend(loc="best")
    return figure
