"""The result of a calibration: printed, drawn, and written where it is accepted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, JustifyMethod
from rich.table import Table

from cmp_tactile_bringup.report.calibration import Report, ReportTable
from cmp_tactile_bringup.terminal import (
    cell,
    output_console,
    print_findings,
    print_line,
    titled_table,
)
from cmp_tactile_processing.cache.files import check_free, expanded_path
from cmp_tactile_processing.calibration.check import CheckReport
from cmp_tactile_processing.calibration.material.loads import MaterialOutcome
from cmp_tactile_processing.calibration.material.relaxation import RelaxationOutcome
from cmp_tactile_processing.calibration.outcome import CalibrationOutcome
from cmp_tactile_processing.errors import OutputError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.rectification import ViewCameraInfo, write_camera_info
from cmp_tactile_processing.geometry.split import split_frame, to_grey
from cmp_tactile_processing.sensor.description import SensorDescription, write_sensor_description

SUFFIXES = (".yaml", ".yml")

# They hold numbers, which stand at the right and do not wrap.
NUMBER_COLUMNS = ("Before", "After", "Change", "Std", "Reference", "Off")
DIM_REMARKS = ("held", "left out")
Outcome = CalibrationOutcome | MaterialOutcome | RelaxationOutcome | CheckReport


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
        check_free(self.written, overwrite=overwrite)

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
    outcome: Outcome, report: Report, folder: Path, write: Callable[[], Sequence[Path]]
) -> int:
    """Print what was found, write the page and what is accepted; returns the exit code.

    folder: of the page.  write: writes and names the files.
    """
    page = report.write(folder, outcome)
    console = output_console()
    for table in report.tables:
        console.print(text_table(table))
    for line in report.lines:
        print_line(console, line)
    print_verdict(console, outcome)
    print_line(console, f"Figures: {page}")
    if not outcome.accepted:
        print_line(console, "Nothing else was written.")
        return 1
    for path in write():
        print_line(console, f"Written: {path}")
    return 0


def print_verdict(console: Console, outcome: Outcome) -> None:
    """What is wrong, and what to do about it, the errors first; then the verdict."""
    print_findings(outcome.findings, console=console)
    print_line(console, outcome.verdict, "bold green" if outcome.accepted else "bold red")


def view_pictures(
    sensor: SensorDescription, frame: NDArray[np.uint8]
) -> dict[str, NDArray[np.uint8]]:
    """The views of a frame, grey."""
    grey = to_grey(frame, sensor.tracking.grey_weights)
    return {name: split_frame(grey, view.placement) for name, view in build_views(sensor).items()}


def text_table(table: ReportTable) -> Table:
    """The table for a terminal."""
    shown = titled_table(table.title, box=None, pad_edge=False, collapse_padding=True)
    for heading in table.headings:
        number = heading in NUMBER_COLUMNS
        justify: JustifyMethod = "right" if number else "left"
        shown.add_column(heading, justify=justify, overflow="fold", no_wrap=number)
    for row in table.rows:
        shown.add_row(*map(cell, row), style="dim" if row[-1].startswith(DIM_REMARKS) else "")
    return shown
