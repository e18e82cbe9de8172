"""What messages of a sensor's results say."""

from __future__ import annotations

from typing import Any

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.image.encodings import BitDepth
from cmp_tactile_processing.ros.messages import reading
from cmp_tactile_processing.sensor.description import SensorDescription


class ResultReader:
    """Reads messages, of ROS or of `rosbags`, by the field of a `Snapshot` that they fill.

    placements: of the sensor's views, by name.
    """

    def __init__(self, sensor: SensorDescription, depth: BitDepth) -> None:
        """depth: of the camera's frames."""
        self._shape, self._depth = sensor.pattern.shape, depth
        self.placements = {name: view.placement for name, view in build_views(sensor).items()}

    def value(self, field: str, message: Any) -> Any:
        """Raises CmpTactileError where the message cannot be used."""
        if field == "frame":
            return reading.image_from_msg(message, depth=self._depth)
        if field == "surface":
            return reading.surface_from_msg(message, self._shape)
        if field == "force":
            return reading.force_field_from_msg(message)
        return reading.grid_from_msg(message, self._shape, self.placements.get(field))
