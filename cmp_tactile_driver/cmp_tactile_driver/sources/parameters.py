"""Parameters of the driver's nodes: one frozen dataclass each, the only home of every default."""

from __future__ import annotations

from dataclasses import dataclass

from cmp_tactile_processing.sensor.description import DEFAULT_SENSOR, SENSOR_NAME_HELP
from cmp_tactile_processing.sensor.parameters import Parameters, parameter

COMPRESSIONS = ("zstd", "png", "jpeg", "none")
MEGABYTE = 10**6


@dataclass(frozen=True)
class CameraDriverParameters(Parameters):
    """Parameters of the node camera_driver, beside those that say of which sensor it is."""

    source: str = parameter(
        "images",
        "source of the frames: v4l2 (a camera), images, video, bag, simulated, or another "
        "installed source",
    )
    input: str = parameter(
        "",
        "folder of images, video file, bag, or scene (name or file); not used with a camera, see "
        "`device`",
    )
    frame_rate: float = parameter(
        0.0,
        "frames per second; 0: rate of the video, bag or scene, highest rate of a camera, "
        "30 for images",
        unit="Hz",
        within=(0.0, 1000.0),
    )
    loop: bool = parameter(False, "begin again at the end of images, video or bag")
    autostart: bool = parameter(
        True, "configure and activate at start, or as soon as a missing camera is found"
    )
    camera_info_url: str = parameter(
        "",
        "YAML file of camera_info_manager, file://PATH or package://PACKAGE/PATH: published "
        "in place of the sensor description's camera_info, and written by set_camera_info",
    )


@dataclass(frozen=True)
class CameraParameters(Parameters):
    """Parameters of the node camera_driver that only the source v4l2 uses."""

    device: str = parameter(
        "",
        "camera: serial number, name in /dev/v4l/by-id or /dev/v4l/by-path, or path; for "
        "two cameras LEFT,RIGHT",
    )
    pixel_format: str = parameter(
        "auto",
        "pixel format of the camera; auto: one that reaches the frame rate, uncompressed if "
        "possible",
        choices=("auto", "GREY", "YUYV", "BGR3", "RGB3", "MJPG", "JPEG"),
    )
    colour: bool = parameter(
        False, "publish colours (bgr8) if the camera has them; else grey values (mono8)"
    )
    frame_timeout: float = parameter(
        2.0,
        "time without a frame after which the camera is opened again",
        unit="s",
        within=(0.05, 60.0),
    )
    reconnect_delay: float = parameter(
        0.5,
        "time before the first attempt to find the camera again; doubled after each attempt, up "
        "to ten times",
        unit="s",
        within=(0.01, 60.0),
    )
    stamp_offset: float = parameter(
        0.0,
        "added to the kernel's time of a frame; negative for a known delay of the camera",
        unit="s",
        within=(-1.0, 1.0),
    )

    pair_tolerance: float = parameter(
        0.005,
        "largest difference between the times of a pair of frames of two cameras",
        unit="s",
        within=(0.0, 1.0),
    )


@dataclass(frozen=True)
class ReplayParameters(Parameters):
    """Parameters of the node replay."""

    input: str = parameter(
        "",
        "bag (folder, .mcap or .db3 file), folder of images, image or video; separate "
        "several by colons, they are played one after the other",
    )
    topic: str = parameter(
        "",
        "image topic of the bag; may be empty if there is only one; LEFT,RIGHT for two cameras: "
        "topics, or recordings in the folder",
    )
    sensor_description: str = parameter(
        DEFAULT_SENSOR,
        "sensor description, a file or a packaged name; gives camera_info and frame ids to "
        "recordings without them",
    )
    sensor_name: str = parameter("", f"{SENSOR_NAME_HELP}; if set, it replaces recorded frame ids")
    frame_rate: float = parameter(
        30.0, "frames per second of an image folder", unit="Hz", within=(0.01, 1000.0)
    )
    rate: float = parameter(1.0, "speed, 1 as recorded", within=(0.01, 100.0))
    start: float = parameter(
        0.0,
        "time in the recording to begin at; a change while it plays jumps there",
        unit="s",
        within=(0.0, 1e6),
    )
    end: float = parameter(
        0.0,
        "time in the recording to end at; 0 for the end of the recording",
        unit="s",
        within=(0.0, 1e6),
    )
    loop: bool = parameter(False, "begin again at the end, with the same stamps")
    paused: bool = parameter(False, "begin paused, until replay/pause is called with false")
    wait_for_subscribers: int = parameter(
        0, "number of subscribers on image_raw to wait for before the first frame", within=(0, 100)
    )
    wait_timeout: float = parameter(
        30.0,
        "time after which it begins without subscribers or other replays that are still missing",
        unit="s",
        within=(0.0, 3600.0),
    )
    begin_with: str = parameter(
        "", "full names of other replays, separated by spaces, to begin at the same time"
    )
    publish_clock: bool = parameter(
        True,
        "publish /clock with the recorded time of each message; set it to true for only one of "
        "several sensors",
    )


@dataclass(frozen=True)
class RecorderParameters(Parameters):
    """Parameters of the node recorder."""

    output: str = parameter(
        "",
        "folder of the bag, which must not exist; empty: made from the sensor's name and the time",
    )
    topics: str = parameter(
        "image_raw camera_info /tf /tf_static wrench force_field",
        "topics, separated by spaces: relative to the namespace, or absolute; * matches anything",
    )
    compression: str = parameter(
        "zstd",
        "compression of frames: zstd (of the file) and png are lossless, jpeg is lossy, "
        "none is the fastest",
        choices=COMPRESSIONS,
    )
    jpeg_quality: int = parameter(95, "quality of jpeg", within=(1, 100))
    queue_size: float = parameter(
        200.0,
        "size of the queue of messages for the disk; when it is full, messages are dropped",
        unit="MB",
        within=(1.0, 1e5),
    )
    autostart: bool = parameter(True, "start recording at once, without a call of ~/record")
    sensor_description: str = parameter(
        DEFAULT_SENSOR, "file or packaged name; stored as sensor.yaml in the bag's folder"
    )
    sensor_name: str = parameter("", SENSOR_NAME_HELP)
