"""One MCAP file of CDR messages, in chunks that are in it whole or not at all.

The records are those of the library `mcap`.  Its own writer ends no chunk before that is full,
compresses at a level that takes a camera frame six times as long, and cannot give up a chunk for
which the disk has no room; that of `rosbags` writes neither checksums nor stamps nor attachments.
"""

from __future__ import annotations

import os
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import yaml
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.writer import MCAP0_MAGIC
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import dump_qos_v9

CHUNK_BYTES = 2**20
ZSTD_LEVEL = 1
NO_TIMES_NS = (2**63 - 1, 0)
"""First and last time of no messages, as rosbag2 writes them."""


@dataclass
class _Chunk:
    """Records that go to the file together, and where the messages of each channel lie in them."""

    content: RecordBuilder = field(default_factory=RecordBuilder)
    indices: dict[int, records.MessageIndex] = field(default_factory=dict)


class McapFile:
    """A new file of the profile ros2; a context manager.

    Every method may raise OSError.  After that the file ends with the last whole chunk, and may
    only be closed.

    counts: messages by topic that are in the file.  times_ns: the first and last of their log
    times.
    """

    def __init__(self, path: Path, *, compressed: bool) -> None:
        """compressed: chunks by zstd."""
        self.path = path
        self._compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL) if compressed else None
        self._file = path.open("xb", buffering=0)
        self._schemas: dict[str, records.Schema] = {}
        self._channels: dict[str, records.Channel] = {}
        self._indices: list[
            records.ChunkIndex | records.AttachmentIndex | records.MetadataIndex
        ] = []
        self._chunk = _Chunk()
        self._whole_bytes = 0
        self.counts: Counter[str] = Counter()
        self.times_ns = NO_TIMES_NS
        self._put(MCAP0_MAGIC + _bytes_of([records.Header("ros2", "cmp_tactile")]))

    def __enter__(self) -> McapFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def size(self) -> int:
        """Bytes in the file and in the chunk to come."""
        return self._whole_bytes + self._chunk.content.count

    @property
    def chunk_is_full(self) -> bool:
        """Whether it is time for `flush`."""
        return self._chunk.content.count > CHUNK_BYTES

    def add_topic(self, topic: str, kind: str, definition: str, qos: Sequence[Qos] = ()) -> None:
        """Name a topic before its first message; again is no fault.  qos: of its publishers."""
        if topic in self._channels:
            return
        if kind not in self._schemas:
            schema = records.Schema(
                id=len(self._schemas) + 1, name=kind, encoding="ros2msg", data=definition.encode()
            )
            self._schemas[kind] = schema
            schema.write(self._chunk.content)
        profiles = [dict(item) for item in dump_qos_v9(list(qos))]
        text = yaml.safe_dump(profiles, sort_keys=False).strip() if profiles else ""
        channel = records.Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding="cdr",
            metadata={"offered_qos_profiles": text},
            schema_id=self._schemas[kind].id,
        )
        self._channels[topic] = channel
        channel.write(self._chunk.content)

    def write(self, topic: str, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Add a message to the chunk to come."""
        channel = self._channels[topic].id
        index = self._chunk.indices.setdefault(channel, records.MessageIndex(channel, []))
        index.records.append((log_ns, self._chunk.content.count))
        message = records.Message(
            channel_id=channel, log_time=log_ns, data=data, publish_time=publish_ns, sequence=0
        )
        message.write(self._chunk.content)

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Add a file."""
        begin = self._whole_bytes
        length = self._put(_bytes_of([records.Attachment(0, 0, name, media_type, data)]))
        index = records.AttachmentIndex(begin, length, 0, 0, len(data), name, media_type)
        self._indices.append(index)

    def describe(self, name: str, facts: Mapping[str, str]) -> None:
        """Add metadata."""
        begin = self._whole_bytes
        length = self._put(_bytes_of([records.Metadata(name, dict(facts))]))
        self._indices.append(records.MetadataIndex(begin, length, name))

    def flush(self) -> None:
        """Hand all messages to the operating system; those that it does not take are dropped."""
        if not self._chunk.indices:
            return
        chunk, self._chunk = self._chunk, _Chunk()
        times = [time for index in chunk.indices.values() for time, _ in index.records]
        data = chunk.content.end()
        record = records.Chunk(
            compression="zstd" if self._compressor else "",
            data=self._compressor.compress(data) if self._compressor else data,
            message_start_time=min(times),
            message_end_time=max(times),
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
        packed, indices = _bytes_of([record]), RecordBuilder()
        begin, offsets = self._whole_bytes, {}
        for channel, index in chunk.indices.items():
            offsets[channel] = begin + len(packed) + indices.count
            index.write(indices)
        index_bytes = indices.end()
        self._put(packed + index_bytes)
        self._indices.append(
            records.ChunkIndex(
                chunk_length=len(packed),
                chunk_start_offset=begin,
                compression=record.compression,
                compressed_size=len(record.data),
                message_end_time=record.message_end_time,
                message_index_length=len(index_bytes),
                message_index_offsets=offsets,
                message_start_time=record.message_start_time,
                uncompressed_size=len(data),
            )
        )
        for topic, known in self._channels.items():
            if known.id in chunk.indices:
                self.counts[topic] += len(chunk.indices[known.id].records)
        self.times_ns = min(self.times_ns[0], *times), max(self.times_ns[1], *times)

    def sync(self) -> None:
        """As `flush`, and have the disk keep it: no power cut takes it any more."""
        self.flush()
        os.fdatasync(self._file.fileno())

    def close(self) -> None:
        """Write the index, and close.  A file without index can still be read from its start."""
        try:
            try:
                self.flush()
            finally:
                self._put_end()
        finally:
            self._file.close()
            # Of a recording in many files each stays known for its times and counts.
            self._indices, self._schemas, self._compressor = [], {}, None

    def _put(self, data: bytes) -> int:
        """Write all of it, or take back what was written in part; how much it is."""
        left = memoryview(data)
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError:
            # Also makes room for the index.
            self._file.truncate(self._whole_bytes)
            self._file.seek(self._whole_bytes)
            raise
        self._whole_bytes += len(data)
        return len(data)

    def _put_end(self) -> None:
        data_end = _bytes_of([records.DataEnd(0)])
        begin = self._whole_bytes + len(data_end)
        kinds = Counter(type(index) for index in self._indices)
        statistics = records.Statistics(
            attachment_count=kinds[records.AttachmentIndex],
            channel_count=len(self._channels),
            channel_message_counts={self._channels[t].id: n for t, n in self.counts.items()},
            chunk_count=kinds[records.ChunkIndex],
            message_count=self.counts.total(),
            message_end_time=self.times_ns[1],
            message_start_time=self.times_ns[0] if self.counts else 0,
            metadata_count=kinds[records.MetadataIndex],
            schema_count=len(self._schemas),
        )
        parts = (*self._schemas.values(), *self._channels.values(), statistics, *self._indices)
        summary = _bytes_of(parts)
        # The checksum covers the footer, too, up to itself.
        footer = _bytes_of([records.Footer(begin, 0, 0)])[:-4]
        checksum = zlib.crc32(footer, zlib.crc32(summary)).to_bytes(4, "little")
        self._put(data_end + summary + footer + checksum + MCAP0_MAGIC)


def _bytes_of(items: Iterable[records.McapRecord]) -> bytes:
    builder = RecordBuilder()
    for item in items:
        item.write(builder)
    return builder.end()
