"""Parameters of the driver's nodes: one frozen dataclass each, the only home of every default."""

from __future__ import annotations

from dataclasses import dataclass

from cmp_tactile_processing.sensor.description import DEFAULT_SENSOR, SENSOR_NAME_HELP
from cmp_tactile_processing.sensor.parameters import Parameters, parameter


@dataclass(frozen=True)
class CameraDriverParameters(Parameters):
    """Parameters of the node camera_driver, beside those that say of which sensor it is."""

    source: str = parameter(
        "images",
        "where the frames come from: v4l2 (a camera), images, video, bag, simulated, or another "
        "source that is installed",
    )
    input: str = parameter(
        "", "folder of images, video file, bag, or scene (name or file); a camera has `device`"
    )
    frame_rate: float = parameter(
        0.0,
        "frames per second; 0 for the video's, bag's or scene's own, the fastest that a camera can "
        "do, or 30 for images",
        unit="Hz",
        within=(0.0, 1000.0),
    )
    loop: bool = parameter(False, "begin again at the end of images, video or bag")
    autostart: bool = parameter(
        True, "configure and activate at start; where a camera is missing, once it is there"
    )
    camera_info_url: str = parameter(
        "",
        "camera_info to publish in place of the sensor description's, and where set_camera_info "
        "keeps it: file://PATH or package://PACKAGE/PATH of a YAML file of camera_info_manager",
    )


@dataclass(frozen=True)
class CameraParameters(Parameters):
    """Parameters of the node camera_driver that only the source v4l2 uses."""

    device: str = parameter(
        "",
        "which camera: serial number, name in /dev/v4l/by-id or /dev/v4l/by-path, or path; two, "
        "with a comma between, for the views left and right",
    )
    pixel_format: str = parameter(
        "auto",
        "pixels that the camera is asked for; auto takes those in which it gives the frame rate, "
        "uncompressed ones first",
        choices=("auto", "GREY", "YUYV", "BGR3", "RGB3", "MJPG", "JPEG"),
    )
    colour: bool = parameter(
        False, "publish the colours of a camera that has them (bgr8); else its grey values (mono8)"
    )
    buffers: int = parameter(4, "frames that the kernel keeps until they are read", within=(2, 32))
    frame_timeout: float = parameter(
        2.0,
        "time without a frame after which the camera is opened again",
        unit="s",
        within=(0.05, 60.0),
    )
    reconnect_delay: float = parameter(
        0.5,
        "time before the first attempt to find the camera again; doubled after each",
        unit="s",
        within=(0.01, 60.0),
    )
    reconnect_delay_max: float = parameter(
        5.0, "longest time between two attempts", unit="s", within=(0.01, 600.0)
    )
    stamp_offset: float = parameter(
        0.0,
        "added to the kernel's time of a frame: a known delay of the camera is negative",
        unit="s",
        within=(-1.0, 1.0),
    )

    pair_tolerance: float = parameter(
        0.005,
        "of two cameras, how far the times of a pair of frames may differ",
        unit="s",
        within=(0.0, 1.0),
    )


@dataclass(frozen=True)
class ReplayParameters(Parameters):
    """Parameters of the node replay."""

    input: str = parameter(
        "",
        "bag (folder, .mcap or .db3 file), folder of images, image or video; several, one "
        "after the other, are separated by colons",
    )
    topic: str = parameter("", "image topic of the bag; empty for the only one")
    sensor_description: str = parameter(
        DEFAULT_SENSOR,
        "file or packaged name; gives camera_info and frame id to recordings that have none",
    )
    sensor_name: str = parameter(
        "", f"{SENSOR_NAME_HELP}; one that is given takes the place of recorded frame ids"
    )
    frame_rate: float = parameter(
        30.0, "frames per second of an image folder", unit="Hz", within=(0.01, 1000.0)
    )
    rate: float = parameter(1.0, "speed, 1 as recorded", within=(0.01, 100.0))
    start: float = parameter(
        0.0,
        "time in the recording to begin at; set while it plays, it goes on from there",
        unit="s",
        within=(0.0, 1e6),
    )
    end: float = parameter(
        0.0, "time in the recording to end at; 0 for its end", unit="s", within=(0.0, 1e6)
    )
    loop: bool = parameter(False, "begin again at the end, with the same stamps")
    paused: bool = parameter(False, "begin paused, until the service ~/pause is called with false")
    wait_for_subscribers: int = parameter(
        0, "subscribers on image_raw before the first frame is sent", within=(0, 100)
    )
    wait_timeout: float = parameter(
        30.0,
        "time after which it begins without them, or without other replays",
        unit="s",
        within=(0.0, 3600.0),
    )
    begin_with: str = parameter(
        "", "full names of other replays, separated by spaces, that are to begin together with this"
    )
    publish_clock: bool = parameter(True, "publish /clock with the recorded time of each message")


COMPRESSIONS = ("zstd", "png", "jpeg", "none")
MEGABYTE = 10**6


@dataclass(frozen=True)
class RecorderParameters(Parameters):
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
    jpeg_quality: int = parameter(95, "of jpeg", within=(1, 100))
    split_size: float = parameter(
        0.0,
        "size after which a new file of the bag begins; 0 for never",
        unit="MB",
        within=(0.0, None),
    )
    split_duration: float = parameter(
        0.0,
        "time after which a new file of the bag begins; 0 for never",
        unit="s",
        within=(0.0, None),
    )
    queue_size: float = parameter(
        200.0,
        "messages that may wait for the disk; what comes while so much waits is dropped",
        unit="MB",
        within=(1.0, 1e5),
    )
    autostart: bool = parameter(True, "record from the start on, without a call of ~/record")
    sensor_description: str = parameter(
        DEFAULT_SENSOR, "file or packaged name; is put beside the bag as sensor.yaml"
    )
    sensor_name: str = parameter("", SENSOR_NAME_HELP)
