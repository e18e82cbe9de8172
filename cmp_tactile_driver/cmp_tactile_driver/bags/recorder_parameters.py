"""Parameters of the node recorder: the only home of every default."""

from __future__ import annotations

from dataclasses import dataclass

from cmp_tactile_processing.sensor.library import DEFAULT_SENSOR, SENSOR_NAME_HELP
from cmp_tactile_processing.sensor.parameters import check_parameters, parameter

__all__ = ["COMPRESSIONS", "RecorderParameters"]

COMPRESSIONS = ("zstd", "png", "jpeg", "none")
MEGABYTE = 10**6


@dataclass(frozen=True)
class RecorderParameters:
    """Parameters of the node recorder."""

    output: str = parameter(
        "", "folder of the bag, which must not be there yet; empty for the sensor's name and time"
    )
    topics: str = parameter(
        "image_raw camera_info /tf /tf_static wrench force_field",
        "topics, separated by spaces: below the namespace, or from / on; * stands for anything",
    )
    compression: str = parameter(
        "zstd",
        "of frames: zstd (images as they are, the file compressed) and png lose nothing, jpeg "
        "does, none is quickest",
        choices=COMPRESSIONS,
    )
    jpeg_quality: int = parameter(95, "of jpeg", low=1, high=100)
    split_size: float = parameter(
        0.0, "size after which a new file of the bag begins; 0 for never", unit="MB", low=0.0
    )
    split_duration: float = parameter(
        0.0, "time after which a new file of the bag begins; 0 for never", unit="s", low=0.0
    )
    queue_size: float = parameter(
        200.0,
        "messages that may wait for the disk; what comes while so much waits is dropped",
        unit="MB",
        low=1.0,
        high=1e5,
    )
    autostart: bool = parameter(True, "record from the start on, without a call of ~/record")
    sensor_description: str = parameter(
        DEFAULT_SENSOR, "file or packaged name; is put beside the bag as sensor.yaml"
    )
    sensor_name: str = parameter("", SENSOR_NAME_HELP)

    def __post_init__(self) -> None:
        check_parameters(self)
