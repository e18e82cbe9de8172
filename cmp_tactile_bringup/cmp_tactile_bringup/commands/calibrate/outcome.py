"""The result of a calibration: printed, drawn, and written where it is accepted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from cmp_tactile_bringup.report.calibration import HEADINGS, estimate_rows, write_calibration_report
from cmp_tactile_bringup.terminal import cell, output_console, print_line, titled_table
from cmp_tactile_processing.cache.files import expanded_path
from cmp_tactile_processing.calibration.material.loads import MaterialOutcome
from cmp_tactile_processing.calibration.material.relaxation import RelaxationOutcome
from cmp_tactile_processing.calibration.outcome import (
    CalibrationOutcome,
    Estimate,
    Finding,
    Severity,
)
from cmp_tactile_processing.errors import OutputError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.rectification import ViewCameraInfo, write_camera_info
from cmp_tactile_processing.geometry.split import split_frame, to_grey
from cmp_tactile_processing.sensor.description import SensorDescription, write_sensor_description

SUFFIXES = (".yaml", ".yml")

# Of an estimate of what several parameters do at once.
COMBINATION = "together: "
NUMBER_COLUMNS = ("Before", "After", "Change", "Std")
WORDY_COLUMNS = ("Parameter", "Unit")
Outcome = CalibrationOutcome | MaterialOutcome | RelaxationOutcome
FINDING_STYLES = {Severity.ERROR: "bold red", Severity.WARNING: "yellow"}


@dataclass(frozen=True)
class CalibrationFiles:
    """Where the results of a calibration go.

    sensor: the new description, None for cameras without one.  cameras: ROS camera_info file of
    each view.  report: folder of the figures, written for refused calibrations too.
    """

    sensor: Path | None
    cameras: dict[str, Path]
    report: Path

    @classmethod
    def of_sensor(cls, output: Path, views: tuple[str, ...]) -> CalibrationFiles:
        """NEW.yaml, NEW_left.yaml, NEW_right.yaml and the folder NEW_calibration.

        Raises OutputError for a name that does not end in .yaml.
        """
        output = expanded_path(output)
        if output.suffix not in SUFFIXES:
            msg = f"{output}: found the suffix {output.suffix!r}, expected .yaml"
            raise OutputError(msg)
        cameras = {view: output.with_name(f"{output.stem}_{view}.yaml") for view in views}
        return cls(output, cameras, output.with_name(f"{output.stem}_calibration"))

    @classmethod
    def of_cameras(cls, folder: Path, views: tuple[str, ...]) -> CalibrationFiles:
        """left.yaml, right.yaml and the folder calibration in `folder`; OutputError for a file."""
        folder = expanded_path(folder)
        if folder.exists() and not folder.is_dir():
            msg = f"{folder}: found a file, expected a folder for the files of two cameras"
            raise OutputError(msg)
        cameras = {view: folder / f"{view}.yaml" for view in views}
        return cls(None, cameras, folder / "calibration")

    @property
    def written(self) -> tuple[Path, ...]:
        """Every file that an accepted calibration writes, apart from the report."""
        return (*((self.sensor,) if self.sensor else ()), *self.cameras.values())

    def check_free(self, *, overwrite: bool) -> None:
        """Raise OutputError where a file is there already; to be called before the work."""
        for path in self.written:
            if path.exists() and not overwrite:
                msg = f"{path}: exists already; --overwrite replaces it"
                raise OutputError(msg)

    def write(
        self,
        sensor: SensorDescription | None,
        cameras: Mapping[str, ViewCameraInfo] | None = None,
        name: str = "",
    ) -> tuple[Path, ...]:
        """Write the results of an accepted calibration; returns the files.  name: of the sensor.

        camera_info files bear the name that ROS tools expect, SENSOR_left and SENSOR_right.
        """
        for view, path in self.cameras.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_camera_info(path, f"{name}_{view}", (cameras or {})[view])
        # Last, so that a description is never there without its camera_info files.
        if self.sensor is not None and sensor is not None:
            write_sensor_description(self.sensor, sensor)
        return self.written


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
            print_line(console, f"The images determine only {estimate.name}")
    for item in outcome.residuals:
        left_out = int((~item.used).sum())
        more = f", {left_out} of {len(item.used)} points left out" if left_out else ""
        print_line(console, f"{item.view} view: reprojection {item.rms:.3f} px RMS{more}")
    return print_end(
        console, outcome, page, lambda: files.write(outcome.sensor, outcome.cameras, name)
    )


def print_end(
    console: Console, result: Outcome, page: Path, write: Callable[[], Sequence[Path]]
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
    table = titled_table("Parameters", box=None, pad_edge=False)
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
