"""Finds sensor descriptions by file name or by the name of a packaged one."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = [
    "DEFAULT_SENSOR",
    "SENSOR_NAME_HELP",
    "find_sensor_description",
    "load_sensor",
    "packaged_sensors",
]

DEFAULT_SENSOR = "prototype"
SENSOR_NAME_HELP = (
    "name of this sensor, with which its tf frames begin; empty for the sensor description's"
)
PACKAGE = "cmp_tactile_processing"


def _config_folders() -> list[Path]:
    source_tree = Path(__file__).resolve().parents[2] / "config"
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    installed = [Path(prefix) / "share" / PACKAGE / "config" for prefix in prefixes if prefix]
    return [folder for folder in (*installed, source_tree) if folder.is_dir()]


def packaged_sensors() -> dict[str, Path]:
    """Names and files of the sensor descriptions that come with the package."""
    found: dict[str, Path] = {}
    for folder in _config_folders():
        for path in sorted(folder.glob("*.yaml")):
            found.setdefault(path.stem, path)
    return found


def find_sensor_description(name_or_path: str) -> Path:
    """The file of a packaged sensor ("sample_rig") or the path as given.

    Raises DescriptionError where there is neither.
    """
    packaged = packaged_sensors()
    if name_or_path in packaged:
        return packaged[name_or_path]
    path = Path(name_or_path).expanduser()
    if path.is_file():
        return path
    msg = f"{name_or_path}: found no such file, expected a path or one of {', '.join(packaged)}"
    raise DescriptionError(msg)


def load_sensor(name_or_path: str, sensor_name: str = "") -> SensorDescription:
    """The sensor description of that name or path; DescriptionError where it cannot be used.

    sensor_name: of this one among several sensors of the same description, instead of its name.
    """
    sensor = SensorDescription.load(find_sensor_description(name_or_path))
    return replace(sensor, name=sensor_name) if sensor_name else sensor
