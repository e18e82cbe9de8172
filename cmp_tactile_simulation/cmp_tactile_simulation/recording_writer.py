"""Simulated frames as a ROS 2 bag (MCAP), without ROS."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer

from cmp_tactile_driver.bag_storage import StoredMessage, open_storage
from cmp_tactile_driver.errors import BagError
from cmp_tactile_driver.image_decoding import decode_compressed
from cmp_tactile_processing.sensor_description import SensorDescription
from cmp_tactile_simulation.errors import OutputError
from cmp_tactile_simulation.frame_messages import FrameMessages, recorded_topics
from cmp_tactile_simulation.frame_output import WrittenFrame
from cmp_tactile_simulation.message_definitions import FORCE_FIELD, SURFACE, simulation_typestore
from cmp_tactile_simulation.simulation import SimulatedFrame

__all__ = ["RecordingWriter", "recorded_frames"]

BAG_VERSION = 9
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"

FrameBytes = dict[str, bytes]


class RecordingWriter:
    """Writes one bag; all messages of a frame bear its stamp.

    The same frames give the same bytes.  Raises OutputError where the folder is there already.
    """

    def __init__(self, bag: Path, sensor: SensorDescription) -> None:
        self._bag = bag
        self._sensor = sensor
        self._messages = FrameMessages(sensor)
        self._topics = recorded_topics(sensor)
        self._writer = Writer(_checked(bag), version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        store = simulation_typestore()
        self._connections = {
            topic: self._writer.add_connection(self._topics.prefix + topic, kind, typestore=store)
            for topic, kind in self._topics.types.items()
        }

    def append(self, frame: SimulatedFrame) -> None:
        """Write the next frame."""
        for topic, data in self._messages.serialised(frame):
            self._writer.write(self._connections[topic], frame.stamp_ns, data)

    def append_recorded(self, stamp_ns: int, frame: FrameBytes) -> None:
        """Write a frame that was recorded before: its messages by topic."""
        for topic, connection in self._connections.items():
            self._writer.write(connection, stamp_ns, frame[topic])

    def close(self) -> None:
        """Write index and metadata.yaml; where there is no frame yet, there is no bag to index."""
        if any(self._writer.counts.values()):
            self._writer.close()
        else:
            self._writer.abort()

    def frames(self) -> Iterator[WrittenFrame]:
        """What was written."""
        for _, frame in recorded_frames(self._bag, self._sensor):
            yield _written(frame)


def recorded_frames(bag: Path, sensor: SensorDescription) -> Iterator[tuple[int, FrameBytes]]:
    """Stamp, and message bytes by topic, of the whole frames of a bag, damaged or not, in order.

    Ends at the first frame that lacks a message.  Nothing where no message can be read.
    """
    prefix, types = recorded_topics(sensor)
    try:
        storage = open_storage(bag)
    except BagError:
        return
    stored = storage.messages([prefix + topic for topic in types])
    for stamp_ns, messages in groupby(stored, key=_time_ns):
        frame = {item.topic.removeprefix(prefix): item.data for item in messages}
        if len(frame) < len(types):
            return
        yield stamp_ns, frame


def _time_ns(message: StoredMessage) -> int:
    return message.time_ns


def _checked(bag: Path) -> Path:
    if bag.exists():
        msg = f"{bag}: exists already, expected a place for a new bag"
        raise OutputError(msg)
    return bag


def _written(frame: FrameBytes) -> WrittenFrame:
    store = simulation_typestore()
    image: Any = store.deserialize_cdr(frame["image_raw/compressed"], COMPRESSED_IMAGE)
    surface: Any = store.deserialize_cdr(frame["truth/surface"], SURFACE)
    force: Any = store.deserialize_cdr(frame["truth/force_field"], FORCE_FIELD)
    grid = surface.rows, surface.cols, 3
    total, moment = force.wrench.force, force.wrench.torque
    return WrittenFrame(
        image=decode_compressed(image.format, image.data),
        corners_m=_doubles(surface.position, grid),
        displacement=_doubles(surface.displacement, grid),
        force_position=_doubles(force.position, (-1, 3)),
        force=_doubles(force.force, (-1, 3)),
        wrench=np.array([total.x, total.y, total.z, moment.x, moment.y, moment.z]),
        contact_area=float(force.contact_area),
    )


def _doubles(values: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    return np.asarray(values, np.float64).reshape(shape)
