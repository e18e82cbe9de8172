"""The result of a calibration: printed, drawn, and written where it is accepted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from cmp_tactile_bringup.calibration.files import CalibrationFiles
from cmp_tactile_bringup.report.calibration import HEADINGS, estimate_rows, write_calibration_report
from cmp_tactile_bringup.terminal.output import cell, output_console, print_line
from cmp_tactile_processing.calibration.outcome import (
    CalibrationOutcome,
    Estimate,
    Finding,
    Severity,
)
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.split import split_frame, to_grey
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = [
    "Verdict",
    "conclude",
    "estimates_table",
    "print_end",
    "print_findings",
    "print_verdict",
    "view_pictures",
    "warn",
]

# Of an estimate of what several parameters do at once.
COMBINATION = "together: "
NUMBER_COLUMNS = ("Before", "After", "Change", "Std")
WORDY_COLUMNS = ("Parameter", "Unit")
FINDING_STYLES = {Severity.ERROR: "bold red", Severity.WARNING: "yellow"}


class Verdict(Protocol):
    """The result of any calibration."""

    @property
    def findings(self) -> Sequence[Finding]:
        """What is wrong, and what to do about it."""

    @property
    def verdict(self) -> str:
        """Whether the result can be used, in words."""

    @property
    def accepted(self) -> bool:
        """Whether the result may be written."""


def conclude(
    outcome: CalibrationOutcome,
    files: CalibrationFiles,
    pictures: Mapping[str, NDArray[np.uint8]],
    name: str,
) -> int:
    """Draw the report, print what was found, write what is accepted; returns the exit code."""
    page = write_calibration_report(outcome, pictures, files.report, name)
    console = output_console()
    single = [item for item in outcome.estimates if not item.name.startswith(COMBINATION)]
    if single:
        console.print(estimates_table(single))
    for estimate in outcome.estimates:
        if estimate.name.startswith(COMBINATION):
            print_line(console, f"Not separated by the images, {estimate.name}")
    for item in outcome.residuals:
        left_out = int((~item.used).sum())
        more = f", {left_out} of {len(item.used)} points left out" if left_out else ""
        print_line(console, f"{item.view} view: reprojection {item.rms:.3f} px RMS{more}")

    def write() -> Sequence[Path]:
        files.write(outcome, name)
        return files.written

    return print_end(console, outcome, page, write)


def print_end(
    console: Console, result: Verdict, page: Path, write: Callable[[], Sequence[Path]]
) -> int:
    """Print findings and verdict, write what is accepted; returns the exit code.

    page: where the figures are.  write: writes and names the files.
    """
    print_findings(console, result.findings)
    print_verdict(console, result.verdict, accepted=result.accepted)
    print_line(console, f"Figures: {page}")
    if not result.accepted:
        print_line(console, "Nothing else was written.")
        return 1
    for path in write():
        print_line(console, f"Written: {path}")
    return 0


def print_findings(console: Console, findings: Sequence[Finding]) -> None:
    """What is wrong, and what to do about it, the errors first."""
    for item in sorted(findings, key=lambda item: item.severity is not Severity.ERROR):
        print_line(console, f"{item.severity.value}: {item.text}", FINDING_STYLES[item.severity])
        print_line(console, f"  what to do: {item.advice}")


def print_verdict(console: Console, verdict: str, *, accepted: bool) -> None:
    """The verdict in words."""
    print_line(console, verdict, "bold green" if accepted else "bold red")


def warn(problem: str) -> None:
    """A line on stderr; none without a problem."""
    if problem:
        print_line(output_console(stderr=True), f"warning: {problem}", "yellow")


def view_pictures(
    sensor: SensorDescription, frame: NDArray[np.uint8]
) -> dict[str, NDArray[np.uint8]]:
    """The views of a frame, grey."""
    grey = to_grey(frame, sensor.tracking.grey_weights)
    return {name: split_frame(grey, view.placement) for name, view in build_views(sensor).items()}


def estimates_table(single: Sequence[Estimate]) -> Table:
    """Parameters before and after."""
    table = Table(
        title="Parameters", title_justify="left", title_style="bold", box=None, pad_edge=False
    )
    for heading in HEADINGS:
        words = heading in WORDY_COLUMNS
        table.add_column(
            heading,
            justify="left" if words else "right",
            overflow="fold",
            no_wrap=heading in NUMBER_COLUMNS,
        )
    for row in estimate_rows(single):
        table.add_row(*map(cell, row), style="dim" if row.state == "held" else "")
    return table
