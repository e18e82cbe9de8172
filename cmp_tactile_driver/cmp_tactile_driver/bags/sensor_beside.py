"""The sensor description that lies beside a recording, where a replay looks for it."""

from __future__ import annotations

from pathlib import Path

from cmp_tactile_driver.errors import BagWriteError
from cmp_tactile_processing.sensor.library import find_sensor_description
from cmp_tactile_processing.sensor.yaml_section import read_yaml
from cmp_tactile_processing.sensor.yaml_text import dump_yaml

__all__ = ["SENSOR_FILE", "put_sensor_beside"]

SENSOR_FILE = "sensor.yaml"


def put_sensor_beside(bag: Path, sensor_description: str, sensor_name: str = "") -> None:
    """Copy a description, file or packaged name, into a bag; sensor_name: instead of its name.

    Raises DescriptionError where there is none, BagWriteError where it cannot be written.
    """
    source = find_sensor_description(sensor_description)
    text = source.read_text(encoding="utf-8")
    if sensor_name:
        text = dump_yaml({**dict(read_yaml(source).items()), "name": sensor_name})
    path = bag / SENSOR_FILE
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        msg = f"{path}: cannot be written: {error.strerror}"
        raise BagWriteError(msg) from None
