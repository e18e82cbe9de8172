"""`cmp_tactile import`: recordings of other sensors through force and slip, into files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cmp_tactile_bringup.commands.options import Choice, Command, Number, argument, option

if TYPE_CHECKING:
    from rich.console import Console

    from cmp_tactile_bringup.offline.imported import Agreement
    from cmp_tactile_driver.sources.markers import MarkerRecording
    from cmp_tactile_processing.sensor.description import SensorDescription

SENSOR = "sensor description with the gel: a file or a packaged name"


@dataclass(frozen=True, kw_only=True)
class _Import(Command):
    """Options of where results are written."""

    output: Annotated[Path, option("folder to write", metavar="DIR")]
    overwrite: Annotated[bool, option("replace existing files")] = False

    def write(self, imports: Sequence[tuple[MarkerRecording, SensorDescription]]) -> int:
        """Write the files of each recording of a sensor, and print what they are."""
        from cmp_tactile_bringup.offline.imported import SUFFIXES, write_import
        from cmp_tactile_bringup.offline.outputs import check_free
        from cmp_tactile_bringup.terminal.output import output_console, print_line

        console, output = output_console(), self.output.expanduser()
        for recording, _ in imports:
            if not self.overwrite:
                check_free(output, recording.name, SUFFIXES)
        output.mkdir(parents=True, exist_ok=True)
        for recording, sensor in imports:
            found = write_import(recording, sensor, output)
            _report(recording, sensor, output, console)
            if found.agreement is not None:
                _report_agreement(recording.name, found.agreement, console)
            for doubt in found.doubts:
                print_line(console, f"warning: {recording.name}: {doubt}", "yellow")
        return 0


@dataclass(frozen=True, kw_only=True)
class Tac3d(_Import):
    """Import recordings of Tac3D sensors: folders with 3D_Positions.npy, 3D_Displacements.npy and
    the other files of its recorder. Force and slip are computed from the displacements. The
    command writes:

      SERIAL.mcap        surface, force field and wrench as the nodes publish them; the sensor's
                         own forces as tac3d/wrench and tac3d/force_points
      SERIAL_wrench.csv  forces over time
      SERIAL.yaml        the description with grid, pitch and surface of this sensor

    `cmp_tactile view SERIAL.mcap` shows the result. `process`, `calibrate force` and `replay` take
    SERIAL.mcap as input.
    """

    folder: Annotated[
        Path, argument("FOLDER", "folder of one sensor, or with the folders of several")
    ]
    sensor: Annotated[str, option(SENSOR)] = "tac3d_ad2"

    def run(self) -> int:
        """Import each sensor's recording, and print how the two forces agree."""
        from cmp_tactile_driver.sources.tac3d import read_tac3d, tac3d_folders
        from cmp_tactile_processing.sensor.description import load_sensor

        sensor = load_sensor(self.sensor)
        recordings = [read_tac3d(folder) for folder in tac3d_folders(self.folder.expanduser())]
        return self.write([(recording, recording.described(sensor)) for recording in recordings])


@dataclass(frozen=True, kw_only=True)
class Markers(_Import):
    """Import marker positions from any tracker, in the plane or in 3-D, and compute force and slip.
    FILE is one of:

      .npy  an array (frames, rows, cols, 2 or 3)
      .npz  such an array as position; optional: reference, time_s or stamp_ns
      .csv  a table with a row for each marker of each frame

    x grows with the column, y with the row. NaN is a marker that was not seen. The command writes
    NAME.mcap, NAME_wrench.csv and NAME.yaml, as `import tac3d` does.
    """

    file: Annotated[Path, argument("FILE", "an .npy, .npz or .csv file")]
    sensor: Annotated[str, option(SENSOR)]
    unit: Annotated[
        str,
        option(
            "unit of lengths in the file; px: pixels of an image of the gel from inside; the "
            "description's pitch gives the scale",
            Choice(("m", "mm", "px")),
        ),
    ] = "m"
    frame_rate: Annotated[
        float, option("frames per second, if the file has no times", Number(0.01, 10_000, "Hz"))
    ] = 30.0
    rest_frames: Annotated[
        int,
        option(
            "without a reference in the file: displacement is relative to the first N frames, in "
            "which nothing touches the gel",
            Number(1, 1000, kind=int),
        ),
    ] = 1

    def run(self) -> int:
        """Import the file."""
        from cmp_tactile_driver.sources.markers import read_markers
        from cmp_tactile_processing.sensor.description import load_sensor

        sensor, path = load_sensor(self.sensor), self.file.expanduser()
        recording = read_markers(path, sensor.pattern, self.unit, self.frame_rate, self.rest_frames)
        return self.write([(recording, sensor)])


def _report(
    recording: MarkerRecording, sensor: SensorDescription, output: Path, console: Console
) -> None:
    from cmp_tactile_bringup.terminal.output import print_line

    frames, name = len(recording.stamp_ns), recording.name
    lost = f", {recording.lost} more were lost" if recording.lost else ""
    print_line(console, f"{name}: {frames} frames{lost} -> {output / name}.mcap")
    pattern, gel = sensor.pattern, sensor.elastomer
    shape = (
        "flat"
        if pattern.surface.type == "plane"
        else f"radius {1e3 * pattern.surface.radius:.1f} mm"
    )
    print_line(
        console, f"{name}: pitch {1e3 * pattern.pitch:.3f} mm, {shape}, E {gel.young / 1e6:.3f} MPa"
    )


def _report_agreement(name: str, found: Agreement, console: Console) -> None:
    from cmp_tactile_bringup.terminal.output import print_line

    along = ", ".join(
        f"{axis} {correlation:.3f} ({left:.2f} N)"
        for axis, correlation, left in zip("xyz", found.correlation, found.left, strict=True)
    )
    print_line(
        console, f"{name}: correlation with the sensor's own force (remaining difference): {along}"
    )
    print_line(console, f"{name}: the sensor's own force is {found.scale:.2f} times ours")
