"""Parameters of the driver's nodes: one frozen dataclass each, the only home of every default."""

from __future__ import annotations

from dataclasses import dataclass

from cmp_tactile_processing.parameters import check_parameters, parameter
from cmp_tactile_processing.sensor_library import DEFAULT_SENSOR, SENSOR_NAME_HELP

__all__ = ["CameraDriverParameters", "ReplayParameters"]


@dataclass(frozen=True)
class CameraDriverParameters:
    """Parameters of the node camera_driver."""

    sensor_description: str = parameter(
        DEFAULT_SENSOR, "file of the sensor description, or name of a packaged one"
    )
    sensor_name: str = parameter("", SENSOR_NAME_HELP)
    source: str = parameter(
        "images",
        "where the frames come from: images, video, simulated, or another source that is installed",
    )
    input: str = parameter("", "folder of images, video file, or scene (name or file)")
    frame_rate: float = parameter(
        0.0,
        "frames per second; 0 for the video's or scene's own, or 30 for images",
        unit="Hz",
        low=0.0,
        high=1000.0,
    )
    loop: bool = parameter(False, "begin again at the end of images or video")
    autostart: bool = parameter(True, "configure and activate at start")

    def __post_init__(self) -> None:
        check_parameters(self, "camera_driver")


@dataclass(frozen=True)
class ReplayParameters:
    """Parameters of the node replay."""

    input: str = parameter("", "bag (folder, .mcap or .db3 file) or folder of images")
    topic: str = parameter("", "image topic of the bag; empty for the only one")
    sensor_description: str = parameter(
        DEFAULT_SENSOR,
        "file or packaged name; gives camera_info and frame id to recordings that have none",
    )
    sensor_name: str = parameter(
        "", f"{SENSOR_NAME_HELP}; one that is given takes the place of recorded frame ids"
    )
    frame_rate: float = parameter(
        30.0, "frames per second of an image folder", unit="Hz", low=0.01, high=1000.0
    )
    rate: float = parameter(1.0, "speed, 1 as recorded", low=0.01, high=100.0)
    start: float = parameter(0.0, "time in the recording to begin at", unit="s", low=0.0, high=1e6)
    loop: bool = parameter(False, "begin again at the end, with the same stamps")
    paused: bool = parameter(False, "begin paused, until the service ~/pause is called with false")
    wait_for_subscribers: int = parameter(
        0, "subscribers on image_raw before the first frame is sent", low=0, high=100
    )
    wait_timeout: float = parameter(
        30.0, "time after which it begins without them", unit="s", low=0.0, high=3600.0
    )
    publish_clock: bool = parameter(True, "publish /clock with the recorded time of each message")

    def __post_init__(self) -> None:
        check_parameters(self, "replay")
