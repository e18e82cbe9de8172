"""The report of a relaxation calibration: the record, and what the new description makes of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_bringup.report import style
from cmp_tactile_bringup.report.calibration.page import write_page
from cmp_tactile_processing.calibration.material.relaxation import RelaxationOutcome
from cmp_tactile_processing.calibration.outcome import Estimate, Finding
from cmp_tactile_processing.force.relaxation import step_weights
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import GelRelaxation, MaterialRecord

__all__ = ["RelaxationReport", "relaxation_figure", "write_relaxation_report"]

CAPTION = (
    "The force into the gel over time: as the elastic model alone shows it, with the relaxation "
    "taken out, and as it is known."
)
NONE = GelRelaxation(0.0, math.nan)


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
    method: str = "relaxation"

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is wrong with the record or the result."""
        return self.outcome.findings

    @property
    def verdict(self) -> str:
        """In a sentence or two."""
        return self.outcome.verdict

    @property
    def accepted(self) -> bool:
        """Whether nothing speaks against using it."""
        return self.outcome.accepted

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
        before, after = gel.relaxation or NONE, outcome.relaxation or NONE
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


def write_relaxation_report(report: RelaxationReport, folder: Path) -> Path:
    """Write the figure and index.html into the folder; returns the page's path."""
    figures = [("relaxation.png", CAPTION, lambda: relaxation_figure(report))]
    return write_page(report, figures, folder, (report.sensor.name, "record tells"))


def relaxation_figure(report: RelaxationReport) -> Figure:
    """The record over time, and what is left of it."""
    figure = style.new_figure(11.0, 5.2)
    axes = figure.subplots()
    if report.reference is not None:
        true = np.broadcast_to(report.reference, report.time_s.shape)
        # A weight is known while it is on.
        true = np.where(
            np.abs(report.reading) > 0.5 * np.nanmax(np.abs(report.reading)), true, np.nan
        )
        axes.plot(report.time_s, true, color=style.MUTED, lw=5, alpha=0.4, label="known")
    axes.plot(report.time_s, report.reading, color=style.SERIES[1], lw=1.8, label="elastic alone")
    axes.plot(
        report.time_s, report.corrected, color=style.SERIES[0], lw=1.8, label="relaxation taken out"
    )
    axes.set_xlabel("time, s")
    axes.set_ylabel("force into the gel, N")
    style.title(axes, "What the gel shows of a load that is held")
    axes.legend(loc="best")
    return figure
