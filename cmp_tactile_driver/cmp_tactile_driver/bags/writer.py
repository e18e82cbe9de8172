"""Writes a bag as rosbag2 does: a folder of MCAP files and metadata.yaml, without ROS.

A recorder that is killed leaves all but the last moment readable.  The records are those of the
library `mcap`.  Its own writer compresses at a level that takes a camera frame twice as long, and
cannot give up a chunk for which the disk has no room.
"""

from __future__ import annotations

import os
import zlib
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC
from rosbags.interfaces import Qos, QosDurability
from rosbags.rosbag2.metadata import dump_qos_v9

from cmp_tactile_driver.errors import BagWriteError
from cmp_tactile_processing.cache.files import atomic_path
from cmp_tactile_processing.ros.messages.definitions import MessageDefinition, message_definition
from cmp_tactile_processing.sensor.description import find_sensor_description
from cmp_tactile_processing.sensor.yaml_section import read_yaml
from cmp_tactile_processing.sensor.yaml_text import dump_yaml

CHUNK_BYTES = 2**20
ZSTD_LEVEL = 1


@dataclass
class FileStatistics:
    """Messages by channel, and the first and last of their log times in ns.

    repeated: those of them that a file before has already.
    """

    counts: Counter[int] = field(default_factory=Counter)
    repeated: Counter[int] = field(default_factory=Counter)
    start_ns: int = 2**63 - 1
    end_ns: int = 0

    def count(self, channel: int, log_ns: int, *, repeated: bool) -> None:
        """Count in a message."""
        self.counts[channel] += 1
        self.repeated[channel] += repeated
        self.start_ns = min(self.start_ns, log_ns)
        self.end_ns = max(self.end_ns, log_ns)

    def add(self, other: FileStatistics) -> None:
        """Count in what another has."""
        self.counts.update(other.counts)
        self.repeated.update(other.repeated)
        self.start_ns = min(self.start_ns, other.start_ns)
        self.end_ns = max(self.end_ns, other.end_ns)


class _Chunk:
    """Records that go to the file together."""

    def __init__(self) -> None:
        self.builder = RecordBuilder()
        self.statistics = FileStatistics()
        self.indices: dict[int, records.MessageIndex] = {}

    def add(self, message: records.Message, *, repeated: bool) -> None:
        index = self.indices.setdefault(
            message.channel_id, records.MessageIndex(message.channel_id, [])
        )
        index.records.append((message.log_time, self.builder.count))
        message.write(self.builder)
        self.statistics.count(message.channel_id, message.log_time, repeated=repeated)


class McapFile:
    """A new file of the profile ros2.

    Every method may raise OSError.  After that the file ends with the last whole chunk, and may
    only be closed.

    statistics: of what is in the file.
    """

    def __init__(self, path: Path, *, compressed: bool) -> None:
        """compressed: chunks by zstd."""
        self.path = path
        self._compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL) if compressed else None
        self._file = path.open("xb", buffering=0)
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._chunk_indices: list[records.ChunkIndex] = []
        self._chunk = _Chunk()
        self.statistics = FileStatistics()
        self._whole_bytes = self._put(
            MCAP0_MAGIC + _bytes_of(records.Header("ros2", "cmp_tactile"))
        )

    @property
    def size(self) -> int:
        """Bytes in the file and in the chunk to come."""
        return self._whole_bytes + self._chunk.builder.count

    def add_channel(self, topic: str, kind: str, definition: str, qos: str) -> int:
        """The number of a new channel of CDR messages.  qos: YAML of the publishers' profiles."""
        schema = next((item for item in self._schemas if item.name == kind), None)
        if schema is None:
            number = len(self._schemas) + 1
            schema = records.Schema(
                id=number, name=kind, encoding="ros2msg", data=definition.encode()
            )
            self._schemas.append(schema)
            schema.write(self._chunk.builder)
        channel = records.Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding="cdr",
            metadata={"offered_qos_profiles": qos},
            schema_id=schema.id,
        )
        self._channels.append(channel)
        channel.write(self._chunk.builder)
        return channel.id

    def write(
        self, channel: int, log_ns: int, publish_ns: int, data: bytes, *, repeated: bool = False
    ) -> None:
        """Add a message; a chunk that is full goes to the file."""
        self._chunk.add(
            records.Message(
                channel_id=channel,
                log_time=log_ns,
                data=data,
                publish_time=publish_ns,
                sequence=0,
            ),
            repeated=repeated,
        )
        if self._chunk.builder.count > CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Hand all messages to the operating system; those that it does not take are dropped."""
        if not self._chunk.indices:
            return
        chunk, self._chunk = self._chunk, _Chunk()
        begin = self._whole_bytes
        try:
            index = self._put_chunk(chunk, begin)
        except OSError:
            self._cut(begin)
            raise
        self._chunk_indices.append(index)
        self.statistics.add(chunk.statistics)
        self._whole_bytes = begin + index.chunk_length + index.message_index_length

    def close(self) -> None:
        """Write the index, and close.  A file without index can still be read from its start."""
        try:
            try:
                self.flush()
            finally:
                self._put_end()
        except OSError:
            self._cut(self._whole_bytes)
            raise
        finally:
            self._file.close()

    def _put(self, data: bytes) -> int:
        """Write all of it; how much that is."""
        left = memoryview(data)
        while left:
            left = left[self._file.write(left) :]
        return len(data)

    def _cut(self, length: int) -> None:
        """Take back what was written in part, which also makes room for the index."""
        self._file.truncate(length)
        self._file.seek(length)

    def _put_chunk(self, chunk: _Chunk, begin: int) -> records.ChunkIndex:
        data, statistics = chunk.builder.end(), chunk.statistics
        packed = self._compressor.compress(data) if self._compressor else data
        record = records.Chunk(
            compression="zstd" if self._compressor else "",
            data=packed,
            message_start_time=statistics.start_ns,
            message_end_time=statistics.end_ns,
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
        length = self._put(_bytes_of(record))
        indices = RecordBuilder()
        offsets = {}
        for channel, index in chunk.indices.items():
            offsets[channel] = begin + length + indices.count
            index.write(indices)
        return records.ChunkIndex(
            chunk_length=length,
            chunk_start_offset=begin,
            compression=record.compression,
            compressed_size=len(packed),
            message_end_time=record.message_end_time,
            message_index_length=self._put(indices.end()),
            message_index_offsets=offsets,
            message_start_time=record.message_start_time,
            uncompressed_size=len(data),
        )

    def _put_end(self) -> None:
        data_end = _bytes_of(records.DataEnd(0))
        begin = self._whole_bytes + len(data_end)
        summary = RecordBuilder()
        offsets = []
        for opcode, group in self._summary_groups():
            start = summary.count
            for record in group:
                record.write(summary)
            if group:
                offsets.append(records.SummaryOffset(opcode, begin + start, summary.count - start))
        offsets_begin = begin + summary.count
        for offset in offsets:
            offset.write(summary)
        data = summary.end()
        # The checksum covers the footer, too, up to itself.
        checksum = zlib.crc32(
            _bytes_of(records.Footer(begin, offsets_begin, 0))[:-4], zlib.crc32(data)
        )
        footer = _bytes_of(records.Footer(begin, offsets_begin, checksum))
        self._put(data_end + data + footer + MCAP0_MAGIC)

    def _summary_groups(self) -> Iterator[tuple[Opcode, list[records.McapRecord]]]:
        counts, empty = self.statistics.counts, not self.statistics.counts
        yield Opcode.SCHEMA, [*self._schemas]
        yield Opcode.CHANNEL, [*self._channels]
        statistics = records.Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(counts),
            chunk_count=len(self._chunk_indices),
            message_count=counts.total(),
            message_end_time=self.statistics.end_ns,
            message_start_time=0 if empty else self.statistics.start_ns,
            metadata_count=0,
            schema_count=len(self._schemas),
        )
        yield Opcode.STATISTICS, [statistics]
        yield Opcode.CHUNK_INDEX, [*self._chunk_indices]


def _bytes_of(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


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


METADATA_VERSION = 9
# Of a latched topic.  Broadcasters of transforms come late, and send a message for each that they
# add: as tf2's listeners, take many.
MOST_KEPT = 100
LEAST_KEPT = {"/tf_static": MOST_KEPT}


@dataclass(frozen=True)
class SplitLimits:
    """When a new file begins: after so many bytes or ns of log time; 0 for never."""

    size_bytes: int = 0
    duration_ns: int = 0


@dataclass(frozen=True)
class _Topic:
    name: str
    kind: str
    definition: MessageDefinition
    qos: tuple[Qos, ...]

    @property
    def kept(self) -> int:
        """How many of its last messages somebody who comes late gets; 0 where it is not latched."""
        if not self.qos or any(
            item.durability != QosDurability.TRANSIENT_LOCAL for item in self.qos
        ):
            return 0
        depth = sum(max(1, item.depth) for item in self.qos)
        return min(MOST_KEPT, max(depth, LEAST_KEPT.get(self.name, 0)))

    def qos_dicts(self) -> list[dict[str, Any]]:
        return [dict(item) for item in dump_qos_v9(list(self.qos))]


@dataclass(frozen=True)
class _WrittenFile:
    name: str
    statistics: FileStatistics


class BagWriter:
    """One bag; not for several threads at once.

    Each file begins with what is latched by then, so that it can be used without those before it.
    Whatever cannot be written raises BagWriteError, after which the bag may only be closed: what
    was written before stays.

    folder: the bag.  counts: messages in the files that are closed, by topic; those that found no
    room not counted.  repeated: how many of them a file before has already.
    """

    def __init__(
        self, folder: Path, *, compressed: bool = False, limits: SplitLimits | None = None
    ) -> None:
        """Makes the folder.  compressed: by zstd, which every reader of MCAP undoes by itself."""
        self.folder = folder
        self._compressed = compressed
        self._limits = limits or SplitLimits()
        self._topics: dict[str, _Topic] = {}
        self._channels: dict[str, int] = {}
        self._files: list[_WrittenFile] = []
        self._latched: dict[str, deque[tuple[int, bytes]]] = {}
        self.counts: Counter[str] = Counter()
        self.repeated: Counter[str] = Counter()
        self._bytes = 0
        self._first_ns = 0
        self._closed = False
        if folder.exists():
            msg = f"{folder}: exists already, expected a place for a new bag"
            raise BagWriteError(msg)
        try:
            folder.mkdir(parents=True)
            self._file = self._open_file()
        except OSError as error:
            raise _write_error(folder, error) from None

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def file(self) -> Path:
        """What is written to now."""
        return self._file.path

    @property
    def file_count(self) -> int:
        """How many files there are."""
        return len(self._files) + (not self._closed)

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return self._bytes + (0 if self._closed else self._file.size)

    def add_topic(self, name: str, kind: str, qos: Sequence[Qos] = ()) -> None:
        """Name a topic before its first message; again is no fault.

        kind: such as "sensor_msgs/msg/Image".  qos: profiles of its publishers, for a replay.
        Raises MessageDefinitionError where the message's definition is not installed.
        """
        if name not in self._topics:
            topic = _Topic(name, kind, message_definition(kind), tuple(qos))
            self._topics[name] = topic
            if topic.kept:
                self._latched[name] = deque(maxlen=topic.kept)

    def write(self, topic: str, log_ns: int, data: bytes, publish_ns: int | None = None) -> None:
        """Add a message.  log_ns: when it came.  data: CDR.  publish_ns: its stamp, if it has.

        A stamp before 1970 cannot be written and counts as none.
        """
        if publish_ns is None or publish_ns < 0:
            publish_ns = log_ns
        if self._is_full(log_ns):
            self.split()
        if not self._first_ns:
            self._first_ns = log_ns
            self._repeat_latched(log_ns)
        self._put(topic, log_ns, publish_ns, data)
        if topic in self._latched:
            message = publish_ns, data
            with suppress(ValueError):  # sent once more
                self._latched[topic].remove(message)
            self._latched[topic].append(message)

    def _repeat_latched(self, log_ns: int) -> None:
        for topic, messages in self._latched.items():
            for publish_ns, data in messages:
                self._put(topic, log_ns, publish_ns, data, repeated=True)
        self._repeated_bytes = self._file.size

    def _put(
        self, topic: str, log_ns: int, publish_ns: int, data: bytes, *, repeated: bool = False
    ) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._add_channel(self._topics[topic])
        try:
            channel = self._channels[topic]
            self._file.write(channel, log_ns, publish_ns, data, repeated=repeated)
        except OSError as error:
            raise _write_error(self._file.path, error) from None

    def flush(self) -> None:
        """Hand all to the operating system, so that it is there even if this process is killed."""
        try:
            self._file.flush()
        except OSError as error:
            raise _write_error(self._file.path, error) from None

    def split(self) -> None:
        """Begin a new file."""
        try:
            self._close_file()
            self._file = self._open_file()
        except OSError as error:
            raise _write_error(self.folder, error) from None

    def close(self) -> None:
        """Write the index and metadata.yaml."""
        try:
            try:
                # Closed already, where no new one could be begun.
                if not self._closed:
                    self._close_file()
            finally:
                self._write_metadata()
        except OSError as error:
            raise _write_error(self.folder, error) from None

    def _is_full(self, log_ns: int) -> bool:
        limits = self._limits
        size = self._file.size - self._repeated_bytes
        if limits.size_bytes and size >= limits.size_bytes:
            return True
        return bool(
            limits.duration_ns and self._first_ns and log_ns - self._first_ns >= limits.duration_ns
        )

    def _open_file(self) -> McapFile:
        name = f"{self.folder.name}_{len(self._files)}.mcap"
        file = McapFile(self.folder / name, compressed=self._compressed)
        self._channels = {}
        self._first_ns = self._repeated_bytes = 0
        self._closed = False
        return file

    def _add_channel(self, topic: _Topic) -> int:
        qos = yaml.safe_dump(topic.qos_dicts(), sort_keys=False).strip() if topic.qos else ""
        return self._file.add_channel(topic.name, topic.kind, topic.definition.text, qos)

    def _close_file(self) -> None:
        try:
            self._file.close()
        finally:
            self._closed = True
            statistics = self._file.statistics
            for topic, channel in self._channels.items():
                self.counts[topic] += statistics.counts[channel]
                self.repeated[topic] += statistics.repeated[channel]
            self._files.append(_WrittenFile(self._file.path.name, statistics))
            with suppress(OSError):
                self._bytes += self._file.path.stat().st_size

    def _write_metadata(self) -> None:
        total = FileStatistics()
        for file in self._files:
            total.add(file.statistics)
        topics = [self._topic_entry(item) for item in self._topics.values()]
        information = {
            "version": METADATA_VERSION,
            "storage_identifier": "mcap",
            **_times(total),
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [file.name for file in self._files],
            "files": [{"path": file.name, **_times(file.statistics)} for file in self._files],
            "custom_data": None,
            "ros_distro": os.environ.get("ROS_DISTRO", ""),
        }
        text = yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False)
        with atomic_path(self.folder / "metadata.yaml") as beside:
            beside.write_text(text, encoding="utf-8")

    def _topic_entry(self, topic: _Topic) -> dict[str, Any]:
        return {
            "topic_metadata": {
                "name": topic.name,
                "type": topic.kind,
                "serialization_format": "cdr",
                "offered_qos_profiles": topic.qos_dicts(),
                "type_description_hash": topic.definition.type_hash,
            },
            "message_count": self.counts[topic.name],
        }


def _times(statistics: FileStatistics) -> dict[str, Any]:
    """The times of no message at all are those that rosbag2 writes."""
    empty = not statistics.counts
    return {
        "duration": {"nanoseconds": 0 if empty else statistics.end_ns - statistics.start_ns},
        "starting_time": {"nanoseconds_since_epoch": statistics.start_ns},
        "message_count": statistics.counts.total(),
    }


def _write_error(path: Path, error: OSError) -> BagWriteError:
    return BagWriteError(f"{path}: cannot be written: {error.strerror}")
