"""Reports of calibrations: figures, and a page with everything that was found out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_bringup.report import style
from cmp_tactile_processing.calibration.material.loads import LoadResult, MaterialOutcome
from cmp_tactile_processing.calibration.material.relaxation import RelaxationOutcome
from cmp_tactile_processing.calibration.outcome import (
    CalibrationOutcome,
    Estimate,
    ViewResiduals,
    WithFindings,
    length_text,
)
from cmp_tactile_processing.elastic.relaxation import step_weights
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import GelRelaxation, MaterialRecord, Pattern

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
CAPTIONS = {
    "residuals.png": (
        "Measured minus modelled position of every point. Arrows in random directions are noise. "
        "Neighbouring arrows in the same direction show an error of the model."
    ),
    "loads.png": (
        "Force of the sensor over the known force, before and after the calibration. On the line "
        "both agree. Bars: two standard deviations of noise and material. Right: the remaining "
        "difference."
    ),
    "relaxation.png": (
        "Force into the gel over time: from the elastic model alone, with the relaxation removed, "
        "and as known."
    ),
    "truth.png": "Mean distance of each marker from its true place in the simulated recording.",
}
# Of an estimate of what several parameters do at once.
COMBINATION = "together: "
HEADINGS = ("Parameter", "Before", "After", "Change", "Std", "Unit", "")
READABLE_UNITS = {"m": ("mm", 1e3), "rad": ("deg", 180 / math.pi), "Pa": ("kPa", 1e-3)}
# So many digits below the first of the standard deviation.
DIGITS_BELOW_STD = 2
FEWEST_DECIMALS, MOST_DECIMALS = 1, 6
DECIMALS_WITHOUT_STD = 4
LOAD_DECIMALS = 3
LOAD_HEADINGS = ("Load", "", "Reference", "Before", "After", "Std", "Off", "")
LOAD_NOTE = (
    "Forces on the gel in the gel frame, N: into the gel is negative. Std: of noise and material, "
    "after. Off: what the sensor shows too much, in per cent of the load."
)
ESTIMATE_NOTE = (
    "Determined: found from the data, with this standard deviation. Partly: found only together "
    "with others. Held: not found from the data, it kept what was known before."
)
NO_RELAXATION = GelRelaxation(0.0, math.nan)


def residual_figure(residuals: Sequence[ViewResiduals], pictures: Mapping[str, Image]) -> Figure:
    """Residuals over each view, magnified.  pictures: one image of each view, where there is."""
    shown = [item for item in residuals if len(item.pixels)]
    spans = [_span(item, pictures.get(item.view)) for item in shown]
    sides = [high - low for low, high in spans]
    widths = [max(AXES_HEIGHT * side[0] / side[1], LEAST_WIDTH) for side in sides]
    figure = style.new_figure(sum(widths) + MARGIN * len(shown), AXES_HEIGHT + MARGIN)
    row = figure.subplots(1, len(shown), squeeze=False)[0]
    for axes, item, span in zip(row, shown, spans, strict=True):
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


def material_figure(loads: Sequence[LoadResult]) -> Figure:
    """Reading against reference before and after, and what is left, for all known components."""
    figure = style.new_figure(12.0, 5.6)
    left, right = figure.subplots(1, 2)
    # Each (loads, 3).
    shown = np.array([known_components(load) for load in loads])
    used = shown & np.array([[load.used] for load in loads])
    known, known_std, before, after, after_std = (
        np.array([getattr(load, name) for load in loads])
        for name in ("reference", "reference_std", "before", "after", "after_std")
    )
    after_std = np.nan_to_num(after_std)
    ends = [known[shown].min(initial=0.0), known[shown].max(initial=0.0)]
    left.plot(ends, ends, color=style.MUTED, lw=1, zorder=0)
    right.axhline(0, color=style.MUTED, lw=1, zorder=0)
    for axis, name in enumerate(AXES):
        own = used[:, axis], axis
        if not used[:, axis].any():
            continue
        look: dict[str, Any] = {
            "color": style.SERIES[axis], "marker": MARKS[axis], "ls": "none", "ms": 6
        }  # fmt: skip
        left.plot(known[own], before[own], **look, fillstyle="none", label=f"{name} before")
        bars = BAR * after_std[own]
        left.errorbar(known[own], after[own], bars, **look, capsize=4, label=f"{name} after")
        bars = BAR * np.hypot(after_std[own], known_std[own])
        right.errorbar(known[own], after[own] - known[own], bars, **look, capsize=4)
    unused = shown & ~used
    if unused.any():
        left.plot(known[unused], before[unused], "x", color=style.MUTED, label="left out")
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


class ReportTable(NamedTuple):
    """A table of texts.  note: what its columns mean."""

    title: str
    headings: tuple[str, ...]
    rows: list[tuple[str, ...]]
    note: str = ""


@dataclass(frozen=True)
class Report:
    """What is printed and written of a calibration, beside its findings and its verdict.

    figures: by file name, one of CAPTIONS.  lines: sentences beside the tables.
    """

    title: str
    figures: Mapping[str, Figure]
    tables: Sequence[ReportTable]
    lines: Sequence[str] = ()

    def write(self, folder: Path, outcome: WithFindings) -> Path:
        """Write the figures and index.html into the folder; returns the page's path."""
        folder.mkdir(parents=True, exist_ok=True)
        for file, figure in self.figures.items():
            style.save_figure(figure, folder / file)
        values = {"report": self, "outcome": outcome, "captions": CAPTIONS}
        return style.write_page(folder / "index.html", "calibration.html.jinja", **values)


def optics_report(outcome: CalibrationOutcome, pictures: Mapping[str, Image], name: str) -> Report:
    """Of camera, mirrors and gel.  pictures: an image of each view.  name: of the sensor."""
    figures, single, lines = {}, [], []
    for estimate in outcome.estimates:
        if estimate.name.startswith(COMBINATION):
            lines.append(f"The images determine only {estimate.name}")
        else:
            single.append(estimate)
    for item in outcome.residuals:
        left_out = int((~item.used).sum())
        more = f", {left_out} of {len(item.used)} points left out" if left_out else ""
        lines.append(f"{item.view} view: reprojection {item.rms:.3f} px RMS{more}")
    if any(len(item.pixels) for item in outcome.residuals):
        figures["residuals.png"] = residual_figure(outcome.residuals, pictures)
    tables = [estimate_table(single)] if single else []
    return Report(f"Calibration of {name}: {outcome.method}", figures, tables, lines)


def material_report(outcome: MaterialOutcome) -> Report:
    """Of the gel's material from loads."""
    lines = []
    if np.isfinite(outcome.offset).all():
        offsets = zip(outcome.offset, outcome.offset_std, strict=True)
        zero = ", ".join(f"{value:+.3f} +- {std:.3f}" for value, std in offsets)
        lines.append(f"Offset of the reference sensor: {zero} N (x, y, z of the gel frame)")
    figures = {"loads.png": material_figure(outcome.loads)} if outcome.loads else {}
    tables = [load_table(outcome.loads)]
    if outcome.estimates:
        tables.append(estimate_table(outcome.estimates))
    title = f"Calibration of {outcome.sensor.name}: {outcome.method}"
    return Report(title, figures, tables, lines)


def estimate_table(estimates: Sequence[Estimate]) -> ReportTable:
    """A row for each estimate in the units that people read, the determined ones first.

    The last column: "held" where it kept its value, "partly" where the data determine it only
    together with others.
    """
    ordered = sorted(estimates, key=lambda item: (not item.determined, item.after == item.before))
    rows = [_estimate_row(item) for item in ordered]
    return ReportTable("Parameters", HEADINGS, rows, ESTIMATE_NOTE)


def _estimate_row(estimate: Estimate) -> tuple[str, ...]:
    unit, factor = READABLE_UNITS.get(estimate.unit, (estimate.unit, 1.0))
    std = estimate.std * factor
    places = _decimals(std)
    change = (estimate.after - estimate.before) * factor
    held = "held" if estimate.after == estimate.before else "partly"
    return (
        estimate.name,
        _number(estimate.before * factor, places),
        _number(estimate.after * factor, places),
        _number(change, places, "+") if change else "-",
        _number(std, places) if estimate.determined else "-",
        unit,
        "determined" if estimate.determined else held,
    )


def _number(value: float, decimals: int, sign: str = "") -> str:
    return f"{value:{sign}.{decimals}f}" if math.isfinite(value) else "-"


def _decimals(std: float) -> int:
    if not math.isfinite(std) or std <= 0:
        return DECIMALS_WITHOUT_STD
    below = DIGITS_BELOW_STD - math.ceil(math.log10(std))
    return min(max(below, FEWEST_DECIMALS), MOST_DECIMALS)


def load_table(loads: Sequence[LoadResult]) -> ReportTable:
    """Rows of all loads: each known component that is a good part of its force."""
    rows = [
        _load_row(load, int(axis), first=number == 0)
        for load in loads
        for number, axis in enumerate(np.flatnonzero(known_components(load)))
    ]
    return ReportTable("Loads, N", LOAD_HEADINGS, rows, LOAD_NOTE)


def _load_row(load: LoadResult, axis: int, *, first: bool) -> tuple[str, ...]:
    size = float(np.linalg.norm(load.reference[np.isfinite(load.reference)]))
    off = load.residual_after[axis] / size if size else math.nan
    values = load.reference, load.before, load.after, load.after_std
    return (
        load.name if first else "",
        AXES[axis],
        *(_number(item[axis], LOAD_DECIMALS) for item in values),
        # Towards 0 or away from it: forces into the gel are negative.
        f"{100 * off * math.copysign(1, load.reference[axis]):+.1f} %",
        f"left out: {load.reason}" if first and not load.used else "",
    )


@dataclass(frozen=True)
class RelaxationRecord:
    """A record and what came of it; time_s (n,), reading (n,) N.

    reference: true force, (n,) N or one number, None where not known.
    """

    sensor: SensorDescription
    outcome: RelaxationOutcome
    time_s: NDArray[np.float64]
    reading: NDArray[np.float64]
    reference: NDArray[np.float64] | float | None

    @property
    def report(self) -> Report:
        """The record over time, and the values."""
        figure = relaxation_figure(self.time_s, self.reading, self.corrected, self.reference)
        title = f"Calibration of {self.sensor.name}: relaxation"
        return Report(title, {"relaxation.png": figure}, [estimate_table(self.estimates)])

    @cached_property
    def scale(self) -> float:
        """True over read force of a quick press; 1 where the load is not known."""
        return self.outcome.scale if math.isfinite(self.outcome.scale) else 1.0

    @cached_property
    def new_sensor(self) -> SensorDescription:
        """The description with the relaxation and, where the load is known, the moduli."""
        gel = self.sensor.elastomer
        layer = replace(gel.shading_layer, young=self.scale * gel.shading_layer.young)
        gel = replace(
            gel,
            young=self.scale * gel.young,
            shading_layer=layer,
            relaxation=self.outcome.relaxation,
            calibration=self._record(gel.calibration),
        )
        return replace(self.sensor, elastomer=gel)

    def _record(self, record: MaterialRecord | None) -> MaterialRecord | None:
        """The material's earlier record with the doubt of the modulus's new scale in it."""
        doubt = self.outcome.scale_std / self.scale
        if record is None or not math.isfinite(doubt):
            return record
        return replace(
            record,
            normal_std=math.hypot(record.normal_std, doubt),
            tangential_std=math.hypot(record.tangential_std, doubt),
            young_std=math.hypot(record.young_std, doubt),
        )

    @cached_property
    def estimates(self) -> tuple[Estimate, ...]:
        """Share, time constant and modulus, before and after."""
        gel, outcome = self.sensor.elastomer, self.outcome
        before, after = gel.relaxation or NO_RELAXATION, outcome.relaxation or NO_RELAXATION
        seen = outcome.relaxation is not None
        name = "elastomer.relaxation."
        known = math.isfinite(outcome.scale)
        young_std = gel.young * outcome.scale_std if known else math.nan
        return (
            Estimate(f"{name}share", "", before.share, after.share, outcome.share_std, seen),
            Estimate(f"{name}time", "s", before.time, after.time, outcome.time_std, seen),
            Estimate("elastomer.young", "Pa", gel.young, self.scale * gel.young, young_std, known),
        )

    @cached_property
    def corrected(self) -> NDArray[np.float64]:
        """The reading with relaxation and scale of the result, (n,) N."""
        found = self.outcome.relaxation
        reading = np.nan_to_num(self.reading)
        lag = np.zeros(len(reading))
        if found is None:
            return self.scale * self.reading
        kept, of_before, of_now = step_weights(np.diff(self.time_s) / found.time)
        for k in range(1, len(reading)):
            lag[k] = kept[k - 1] * lag[k - 1] + of_before[k - 1] * reading[k - 1]
            lag[k] += of_now[k - 1] * reading[k]
        return self.scale * (self.reading - found.share * lag)
