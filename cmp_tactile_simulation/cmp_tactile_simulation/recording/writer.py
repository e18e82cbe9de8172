"""Simulated frames as a ROS 2 bag (MCAP), without ROS."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter

from cmp_tactile_processing.ros.messages.definitions import simulation_typestore
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.errors import OutputError
from cmp_tactile_simulation.recording.frame_messages import FrameMessages, recorded_topics
from cmp_tactile_simulation.recording.frame_output import WrittenFrame
from cmp_tactile_simulation.recording.reader import FrameBytes, recorded_frames, written_frame
from cmp_tactile_simulation.scenes.simulation import SimulatedFrame

__all__ = ["RecordingWriter"]


class RecordingWriter:
    """Writes one bag; all messages of a frame bear its stamp.

    The same frames give the same bytes.  Raises OutputError where the folder is there already.
    """

    def __init__(self, bag: Path, sensor: SensorDescription) -> None:
        self._bag = bag
        self._sensor = sensor
        self._messages = FrameMessages(sensor)
        self._topics = recorded_topics(sensor)
        self._writer = Writer(_checked(bag), version=9, storage_plugin=StoragePlugin.MCAP)
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
        self._make_durable()

    def append_recorded(self, stamp_ns: int, frame: FrameBytes) -> None:
        """Write a frame that was recorded before: its messages by topic."""
        for topic, connection in self._connections.items():
            self._writer.write(connection, stamp_ns, frame[topic])
        self._make_durable()

    def close(self) -> None:
        """Write index and metadata.yaml; where there is no frame yet, there is no bag to index."""
        if any(self._writer.counts.values()):
            self._writer.close()
        else:
            self._writer.abort()

    def _make_durable(self) -> None:
        """A frame is a chunk of the file: should the process be killed, only the next is lost."""
        storage = self._writer.storage
        if isinstance(storage, McapWriter):
            storage.close_chunk()
            storage.bio.flush()

    def frames(self) -> Iterator[WrittenFrame]:
        """What was written."""
        for _, frame in recorded_frames(self._bag, self._sensor):
            yield written_frame(frame, self._sensor)


def _checked(bag: Path) -> Path:
    if bag.exists():
        msg = f"{bag}: exists already, expected a place for a new bag"
        raise OutputError(msg)
    return bag
