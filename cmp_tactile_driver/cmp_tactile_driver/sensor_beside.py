"""The sensor description that lies beside a recording, where a replay looks for it."""

from __future__ import annotations

from pathlib import Path

import yaml

from cmp_tactile_driver.errors import BagWriteError
from cmp_tactile_processing.sensor_library import find_sensor_description

__all__ = ["SENSOR_FILE", "put_sensor_beside"]

SENSOR_FILE = "sensor.yaml"


def put_sensor_beside(bag: Path, sensor_description: str, sensor_name: str = "") -> None:
    """Copy a description, file or packaged name, into a bag; sensor_name: instead of its name.

    Raises DescriptionError where there is none, BagWriteError where it cannot be written.
    """
    text = find_sensor_description(sensor_description).read_text(encoding="utf-8")
    if sensor_name:
        text = yaml.safe_dump({**yaml.safe_load(text), "name": sensor_name}, sort_keys=False)
    path = bag / SENSOR_FILE
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        msg = f"{path}: cannot be written: {error.strerror}"
        raise BagWriteError(msg) from None
