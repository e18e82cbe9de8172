"""Files of a calibration: written all together, and only when it is accepted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cmp_tactile_bringup.errors import OutputError
from cmp_tactile_processing.calibration.outcome import CalibrationOutcome
from cmp_tactile_processing.geometry.camera_info_file import write_camera_info
from cmp_tactile_processing.sensor.description import SensorDescription, write_sensor_description

__all__ = ["CalibrationFiles"]

SUFFIXES = (".yaml", ".yml")
VIEWS = ("left", "right")


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
    def of_sensor(cls, output: Path, views: tuple[str, ...] = VIEWS) -> CalibrationFiles:
        """NEW.yaml, NEW_left.yaml, NEW_right.yaml and the folder NEW_calibration.

        Raises OutputError for a name that does not end in .yaml.
        """
        output = output.expanduser()
        if output.suffix not in SUFFIXES:
            msg = f"{output}: found the suffix {output.suffix!r}, expected .yaml"
            raise OutputError(msg)
        cameras = {view: output.with_name(f"{output.stem}_{view}.yaml") for view in views}
        return cls(output, cameras, output.with_name(f"{output.stem}_calibration"))

    @classmethod
    def of_cameras(cls, folder: Path, views: tuple[str, ...]) -> CalibrationFiles:
        """left.yaml, right.yaml and the folder calibration in `folder`; OutputError for a file."""
        folder = folder.expanduser()
        if folder.exists() and not folder.is_dir():
            msg = f"{folder}: found a file, expected a folder: two cameras have a file each"
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

    def write(self, outcome: CalibrationOutcome, name: str) -> None:
        """Write the results of an accepted calibration.  name: of the sensor.

        camera_info files bear the name that ROS tools expect, SENSOR_left and SENSOR_right.
        Raises ValueError for a calibration that was refused.
        """
        if not outcome.accepted:
            msg = "a refused calibration is not to be written"
            raise ValueError(msg)
        for view, path in self.cameras.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_camera_info(path, f"{name}_{view}", outcome.cameras[view])
        # Last, so that a description is never there without its camera_info files.
        if self.sensor is not None and outcome.sensor is not None:
            write_sensor_description(self.sensor, outcome.sensor)

    def write_sensor(self, sensor: SensorDescription) -> Sequence[Path]:
        """Write a description alone; returns the files that are written."""
        if self.sensor is None:
            return ()
        write_sensor_description(self.sensor, sensor)
        return (self.sensor,)
