"""`cmp_tactile import`: recordings of other sensors through force and slip, into files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cmp_tactile_bringup.commands.options import Command, argument, option

if TYPE_CHECKING:
    from rich.console import Console

    from cmp_tactile_bringup.offline.imported import Agreement
    from cmp_tactile_driver.sources.tac3d import Tac3dRecording
    from cmp_tactile_processing.sensor.description import SensorDescription


@dataclass(frozen=True, kw_only=True)
class Tac3d(Command):
    """Take over recordings of Tac3D sensors: folders with 3D_Positions.npy, 3D_Displacements.npy
    and what else its recorder writes. Force and slip are worked out from the displacements.
    Written are SERIAL.mcap (surface, force field and wrench as the nodes publish them, and the
    sensor's own as tac3d/wrench and tac3d/force_points), SERIAL_wrench.csv, and SERIAL.yaml, the
    description with pitch and surface of this very sensor. `cmp_tactile view SERIAL.mcap` shows
    the result, `ros2 bag play` sends it to nodes and RViz.
    """

    folder: Annotated[Path, argument("FOLDER", "of one sensor, or with folders of several")]
    output: Annotated[Path, option("where to write", metavar="DIR")]
    sensor: Annotated[
        str, option("file of a sensor description or name of a packaged one: what the gel is")
    ] = "tac3d_ad2"
    calibrate: Annotated[
        bool, option("take Young's modulus from the sensor's own resultant force")
    ] = False

    overwrite: Annotated[bool, option("replace files that are there already")] = False

    def run(self) -> int:
        """Import each sensor's recording, and print how the two forces agree."""
        from cmp_tactile_bringup.offline.imported import (
            check_free,
            with_own_modulus,
            write_import,
        )
        from cmp_tactile_bringup.terminal.output import output_console
        from cmp_tactile_driver.sources.tac3d import read_tac3d, tac3d_folders
        from cmp_tactile_processing.sensor.description import load_sensor

        console, sensor = output_console(), load_sensor(self.sensor)
        output = self.output.expanduser()
        recordings = [read_tac3d(folder) for folder in tac3d_folders(self.folder.expanduser())]
        for recording in recordings:
            if not self.overwrite:
                check_free(recording, output)
        output.mkdir(parents=True, exist_ok=True)
        for recording in recordings:
            own = recording.described(sensor)
            if self.calibrate:
                own = with_own_modulus(recording, own)
            found = write_import(recording, own, output)
            _report(recording, own, found, output, console)
        return 0


def _report(
    recording: Tac3dRecording,
    sensor: SensorDescription,
    found: Agreement | None,
    output: Path,
    console: Console,
) -> None:
    from cmp_tactile_bringup.terminal.output import print_line

    frames, name = len(recording.stamp_ns), recording.serial
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
    if found is None:
        print_line(console, f"{name}: the sensor says nothing of its force")
        return
    along = ", ".join(
        f"{axis} {correlation:.3f} ({left:.2f} N)"
        for axis, correlation, left in zip("xyz", found.correlation, found.left, strict=True)
    )
    print_line(console, f"{name}: correlation with its own force, and what is left of it: {along}")
    print_line(console, f"{name}: its own force is {found.scale:.2f} times ours")
