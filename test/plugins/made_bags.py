"""Bags of made frames and other messages, written with rosbags alone; videos of frames."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

FIRST_STAMP_NS = 1_700_000_000 * 10**9
FRAME_NS = 50_000_000
STORE = get_typestore(Stores.ROS2_JAZZY)


def frames(count: int, height: int = 48, width: int = 64) -> list[NDArray[np.uint8]]:
    """Frames of noise, so that no two are alike."""
    generator = np.random.default_rng(7)
    return [generator.integers(0, 256, (height, width), np.uint8) for _ in range(count)]


def stamps(count: int) -> list[int]:
    """The stamps of so many frames at 20 Hz."""
    return [FIRST_STAMP_NS + number * FRAME_NS for number in range(count)]


def header(stamp_ns: int, frame_id: str = "rig_camera_optical_frame") -> Any:
    """A std_msgs/Header."""
    stamp = STORE.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    return STORE.types["std_msgs/msg/Header"](stamp, frame_id)


def image(frame: NDArray[np.uint8], stamp_ns: int, **changes: Any) -> Any:
    """A sensor_msgs/Image; mono8, or bgr8 where the frame is of colours."""
    fields = {
        "header": header(stamp_ns),
        "height": frame.shape[0],
        "width": frame.shape[1],
        "encoding": "mono8" if frame.ndim == 2 else "bgr8",
        "is_bigendian": 0,
        "step": frame[0].nbytes,
        "data": frame.ravel(),
    }
    return STORE.types["sensor_msgs/msg/Image"](**{**fields, **changes})


def images(shown: Sequence[NDArray[np.uint8]]) -> list[Any]:
    """The frames as sensor_msgs/Image at 20 Hz."""
    return [image(frame, stamp) for frame, stamp in zip(shown, stamps(len(shown)), strict=True)]


def compressed(frame: NDArray[np.uint8], stamp_ns: int) -> Any:
    """The frame as PNG in a sensor_msgs/CompressedImage."""
    return STORE.types["sensor_msgs/msg/CompressedImage"](
        header=header(stamp_ns),
        format="mono8; png compressed ",
        data=cv2.imencode(".png", frame)[1].ravel(),
    )


def camera_info(frame: NDArray[np.uint8], stamp_ns: int) -> Any:
    """A calibration that no sensor description has."""
    roi = STORE.types["sensor_msgs/msg/RegionOfInterest"](1, 2, 3, 4, do_rectify=True)
    return STORE.types["sensor_msgs/msg/CameraInfo"](
        header=header(stamp_ns),
        height=frame.shape[0],
        width=frame.shape[1],
        distortion_model="plumb_bob",
        d=np.array([0.1, 0.2, 0.3, 0.4, 0.5]),
        k=np.arange(9.0),
        r=np.eye(3).ravel(),
        p=np.arange(12.0),
        binning_x=2,
        binning_y=2,
        roi=roi,
    )


def write_video(path: Path, codec: str, shown: Sequence[NDArray[np.uint8]]) -> Path:
    """A video of (height, width, 3) frames at 25 Hz."""
    height, width = shown[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 25.0, (width, height))
    assert writer.isOpened()
    for frame in shown:
        writer.write(frame)
    writer.release()
    return path


def assert_played(found: Iterable[Any], shown: Sequence[NDArray[np.uint8]]) -> None:
    """What a reader gives is these frames, with the stamps of `stamps`."""
    read = list(found)
    assert [frame.stamp_ns for frame in read] == stamps(len(shown))
    assert all(np.array_equal(a.image, b) for a, b in zip(read, shown, strict=True))


def vector(values: Sequence[float]) -> Any:
    """A geometry_msgs/Vector3."""
    return STORE.types["geometry_msgs/msg/Vector3"](*map(float, values))


def wrench(stamp_ns: int, values: Sequence[float]) -> Any:
    """A geometry_msgs/WrenchStamped of a force sensor: force and torque."""
    both = STORE.types["geometry_msgs/msg/Wrench"](vector(values[:3]), vector(values[3:]))
    return STORE.types["geometry_msgs/msg/WrenchStamped"](header(stamp_ns, "ft"), both)


def write_rows(
    path: Path,
    rows: Iterable[tuple[str, int, Any]],
    storage: StoragePlugin = StoragePlugin.MCAP,
    store: Any = STORE,
) -> Path:
    """A bag of messages in this order: topic, time of receipt in ns, message."""
    with Writer(path, version=9, storage_plugin=storage) as writer:
        topics: dict[str, Any] = {}
        for topic, received_ns, message in rows:
            kind = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(topics[topic], received_ns, store.serialize_cdr(message, kind))
    return path


def write(
    path: Path, topics: Mapping[str, Sequence[Any]], storage: StoragePlugin = StoragePlugin.MCAP
) -> Path:
    """A bag of messages by topic, each of which receives one every 50 ms."""
    longest = max(map(len, topics.values()))
    rows = [
        (topic, received_ns, messages[number])
        for number, received_ns in enumerate(stamps(longest))
        for topic, messages in topics.items()
        if number < len(messages)
    ]
    return write_rows(path, rows, storage)
