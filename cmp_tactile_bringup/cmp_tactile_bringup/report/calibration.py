"""Reports of calibrations: figures, and a page with everything that was found out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_bringup.report import calibration_figures, style
from cmp_tactile_processing.calibration.material.loads import LoadResult, MaterialOutcome
from cmp_tactile_processing.calibration.material.relaxation import RelaxationOutcome
from cmp_tactile_processing.calibration.outcome import CalibrationOutcome, Estimate
from cmp_tactile_processing.elastic.relaxation import step_weights
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import GelRelaxation, MaterialRecord

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
}
HEADINGS = ("Parameter", "Before", "After", "Change", "Std", "Unit", "")
READABLE_UNITS = {"m": ("mm", 1e3), "rad": ("deg", 180 / math.pi), "Pa": ("kPa", 1e-3)}
# So many digits below the first of the standard deviation.
DIGITS_BELOW_STD = 2
FEWEST_DECIMALS, MOST_DECIMALS = 1, 6
DECIMALS_WITHOUT_STD = 4
LOAD_HEADINGS = ("Load", "", "Reference", "Before", "After", "Std", "Off", "")
NO_RELAXATION = GelRelaxation(0.0, math.nan)


def write_calibration_report(
    outcome: CalibrationOutcome, pictures: Mapping[str, NDArray[np.uint8]], folder: Path, name: str
) -> Path:
    """Write the figures and index.html into the folder; returns the page's path.

    pictures: an image of each view, which the residuals are drawn over.  name: of the sensor.
    """
    figures: dict[str, Callable[[], Figure]] = {}
    if any(len(item.pixels) for item in outcome.residuals):
        draw = calibration_figures.residual_figure
        figures["residuals.png"] = lambda: draw(outcome.residuals, pictures)
    return _write(folder, figures, source="images", **_found(outcome, name))


def write_material_report(outcome: MaterialOutcome, folder: Path, name: str) -> Path:
    """Write the figure and index.html into the folder; returns the page's path."""
    figures = (
        {"loads.png": lambda: calibration_figures.material_figure(outcome.loads)}
        if outcome.loads
        else {}
    )
    loads: dict[str, Any] = {
        "loads": load_rows(outcome.loads),
        "load_headings": LOAD_HEADINGS,
    }
    return _write(folder, figures, source="loads", **loads, **_found(outcome, name))


def _found(outcome: CalibrationOutcome | MaterialOutcome, name: str) -> dict[str, Any]:
    return {
        "estimates": outcome.estimates,
        "name": name,
        "outcome": outcome,
        "method": outcome.method,
    }


def write_relaxation_report(report: RelaxationReport, folder: Path) -> Path:
    """Write the figure and index.html into the folder; returns the page's path."""
    curves = (report.time_s, report.reading, report.corrected)
    figures = {
        "relaxation.png": lambda: calibration_figures.relaxation_figure(*curves, report.reference)
    }
    return _write(
        folder,
        figures,
        estimates=report.estimates,
        name=report.sensor.name,
        outcome=report.outcome,
        method="relaxation",
        source="record",
    )


def _write(
    folder: Path,
    figures: Mapping[str, Callable[[], Figure]],
    *,
    estimates: Sequence[Estimate],
    **values: Any,
) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for file, draw in figures.items():
        style.save_figure(draw(), folder / file)
    captions = {file: CAPTIONS[file] for file in figures}
    tables = {"captions": captions, "headings": HEADINGS, "estimates": estimate_rows(estimates)}
    return style.write_page(folder / "index.html", "calibration.html.jinja", **values, **tables)


class EstimateRow(NamedTuple):
    """A parameter as texts, in the order of HEADINGS and in the units that people read.

    state, of one that is not determined: "held" where it kept its value, "partly" where the data
    determine it only together with others.
    """

    name: str
    before: str
    after: str
    change: str
    std: str
    unit: str
    state: str


def estimate_rows(estimates: Sequence[Estimate]) -> list[EstimateRow]:
    """A row for each estimate, those that the data determined first."""
    ordered = sorted(estimates, key=lambda item: (not item.determined, item.after == item.before))
    return [_estimate_row(item) for item in ordered]


def _estimate_row(estimate: Estimate) -> EstimateRow:
    unit, factor = READABLE_UNITS.get(estimate.unit, (estimate.unit, 1.0))
    std = estimate.std * factor
    places = _decimals(std)

    def text(value: float, sign: str = "") -> str:
        return f"{value:{sign}.{places}f}" if math.isfinite(value) else "-"

    change = (estimate.after - estimate.before) * factor
    held = "held" if estimate.after == estimate.before else "partly"
    return EstimateRow(
        name=estimate.name,
        before=text(estimate.before * factor),
        after=text(estimate.after * factor),
        change=text(change, "+") if change else "-",
        std=text(std) if estimate.determined else "-",
        unit=unit,
        state="determined" if estimate.determined else held,
    )


def _decimals(std: float) -> int:
    if not math.isfinite(std) or std <= 0:
        return DECIMALS_WITHOUT_STD
    below = DIGITS_BELOW_STD - math.ceil(math.log10(std))
    return min(max(below, FEWEST_DECIMALS), MOST_DECIMALS)


class LoadRow(NamedTuple):
    """One component of a load as texts, N, in the order of LOAD_HEADINGS.

    off: what the sensor shows too much, in per cent of the load.
    """

    name: str
    component: str
    reference: str
    before: str
    after: str
    std: str
    off: str
    remark: str


def load_rows(loads: Sequence[LoadResult]) -> list[LoadRow]:
    """Rows of all loads: each known component that is a good part of its force."""
    return [
        _load_row(load, int(axis), first=number == 0)
        for load in loads
        for number, axis in enumerate(np.flatnonzero(calibration_figures.known_components(load)))
    ]


def _load_row(load: LoadResult, axis: int, *, first: bool) -> LoadRow:
    size = float(np.linalg.norm(load.reference[np.isfinite(load.reference)]))
    off = load.residual_after[axis] / size if size else math.nan

    def force(values: NDArray[np.float64]) -> str:
        return f"{values[axis]:.3f}" if math.isfinite(values[axis]) else "-"

    return LoadRow(
        name=load.name if first else "",
        component=calibration_figures.AXES[axis],
        reference=force(load.reference),
        before=force(load.before),
        after=force(load.after),
        std=force(load.after_std),
        # Towards 0 or away from it: forces into the gel are negative.
        off=f"{100 * off * math.copysign(1, load.reference[axis]):+.1f} %",
        remark=f"left out: {load.reason}" if first and not load.used else "",
    )


@dataclass(frozen=True)
class RelaxationReport:
    """A record and what came of it; time_s (n,), reading (n,) N.

    reference: true force, (n,) N or one number, None where not known.
    """

    sensor: SensorDescription
    outcome: RelaxationOutcome
    time_s: NDArray[np.float64]
    reading: NDArray[np.float64]
    reference: NDArray[np.float64] | float | None

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
