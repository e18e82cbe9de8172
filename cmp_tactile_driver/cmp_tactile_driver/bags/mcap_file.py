"""Writes one MCAP file so that a recorder that is killed leaves all but the last moment readable.

The records are those of the library `mcap`.  Its own writer compresses at a level that takes a
camera frame twice as long, and cannot give up a chunk for which the disk has no room.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

__all__ = ["FileStatistics", "McapFile"]

CHUNK_BYTES = 2**20
ZSTD_LEVEL = 1


@dataclass
class FileStatistics:
    """Messages by channel, and the first and last of their log times in ns."""

    counts: Counter[int] = field(default_factory=Counter)
    start_ns: int = 2**63 - 1
    end_ns: int = 0

    def count(self, channel: int, log_ns: int) -> None:
        """Count in a message."""
        self.counts[channel] += 1
        self.start_ns = min(self.start_ns, log_ns)
        self.end_ns = max(self.end_ns, log_ns)

    def add(self, other: FileStatistics) -> None:
        """Count in what another has."""
        self.counts.update(other.counts)
        self.start_ns = min(self.start_ns, other.start_ns)
        self.end_ns = max(self.end_ns, other.end_ns)


class _Chunk:
    """Records that go to the file together."""

    def __init__(self) -> None:
        self.builder = RecordBuilder()
        self.statistics = FileStatistics()
        self.indices: dict[int, MessageIndex] = {}

    def add(self, message: Message) -> None:
        index = self.indices.setdefault(message.channel_id, MessageIndex(message.channel_id, []))
        index.records.append((message.log_time, self.builder.count))
        message.write(self.builder)
        self.statistics.count(message.channel_id, message.log_time)


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
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunk_indices: list[ChunkIndex] = []
        self._chunk = _Chunk()
        self.statistics = FileStatistics()
        self._whole_bytes = self._put(MCAP0_MAGIC + _bytes_of(Header("ros2", "cmp_tactile")))

    @property
    def size(self) -> int:
        """Bytes in the file and in the chunk to come."""
        return self._whole_bytes + self._chunk.builder.count

    def add_channel(self, topic: str, kind: str, definition: str, qos: str) -> int:
        """The number of a new channel of CDR messages.  qos: YAML of the publishers' profiles."""
        schema = next((item for item in self._schemas if item.name == kind), None)
        if schema is None:
            number = len(self._schemas) + 1
            schema = Schema(id=number, name=kind, encoding="ros2msg", data=definition.encode())
            self._schemas.append(schema)
            schema.write(self._chunk.builder)
        channel = Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding="cdr",
            metadata={"offered_qos_profiles": qos},
            schema_id=schema.id,
        )
        self._channels.append(channel)
        channel.write(self._chunk.builder)
        return channel.id

    def write(self, channel: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Add a message; a chunk that is full goes to the file."""
        self._chunk.add(
            Message(
                channel_id=channel,
                log_time=log_ns,
                data=data,
                publish_time=publish_ns,
                sequence=0,
            )
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

    def _put_chunk(self, chunk: _Chunk, begin: int) -> ChunkIndex:
        data, statistics = chunk.builder.end(), chunk.statistics
        packed = self._compressor.compress(data) if self._compressor else data
        record = Chunk(
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
        return ChunkIndex(
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
        data_end = _bytes_of(DataEnd(0))
        begin = self._whole_bytes + len(data_end)
        summary = RecordBuilder()
        offsets = []
        for opcode, records in self._summary_groups():
            start = summary.count
            for record in records:
                record.write(summary)
            if records:
                offsets.append(SummaryOffset(opcode, begin + start, summary.count - start))
        offsets_begin = begin + summary.count
        for offset in offsets:
            offset.write(summary)
        data = summary.end()
        # The checksum covers the footer, too, up to itself.
        checksum = zlib.crc32(_bytes_of(Footer(begin, offsets_begin, 0))[:-4], zlib.crc32(data))
        footer = _bytes_of(Footer(begin, offsets_begin, checksum))
        self._put(data_end + data + footer + MCAP0_MAGIC)

    def _summary_groups(self) -> Iterator[tuple[Opcode, list[McapRecord]]]:
        counts, empty = self.statistics.counts, not self.statistics.counts
        yield Opcode.SCHEMA, [*self._schemas]
        yield Opcode.CHANNEL, [*self._channels]
        statistics = Statistics(
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


def _bytes_of(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
