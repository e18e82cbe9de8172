"""Files of bags, MCAP and rosbag2's SQLite format, whole, without index or end, or damaged.

MCAP records are gone through by their lengths: an index would only say where they are.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import IO, Any, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
HEAD_BYTES = 12
"""Of a message: what names the encoding, and the stamp of a header that it begins with."""

RECORD_HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
CHUNK_HEAD = struct.Struct("<QQQI")
NO_CHUNK = 0
# One in use, and those that others overlap in time.
KEPT_CHUNKS = 4
MOST_SUMMARY_BYTES = 2**30

LOG_SUFFIX = "-wal"


class DamageError(Exception):
    """Bytes that are no message, no file of its format, or are not there."""


@dataclass(frozen=True)
class StoredMessage:
    """One message as it was recorded.

    time_ns: when it was received.  stamp_ns: of its header, if its type begins with one; 0 where it
    has none.  where: for the reading of its file, which is the `file`th of its bag.  time_s: in its
    recording, see `Timeline`.  data: its CDR bytes, empty until they are read.
    """

    topic: str
    kind: str
    time_ns: int
    stamp_ns: int
    where: Any
    file: int = 0
    time_s: float = 0.0
    data: bytes = b""

    @property
    def moment_ns(self) -> int:
        """Its stamp; when it was received where it has none."""
        return self.stamp_ns or self.time_ns


def unpacked(data: bytes) -> bytes:
    """A message that rosbag2 may have compressed by itself; DamageError where it cannot be."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    # Takes frames that do not state how long their content is, too.
    unpacking = zstandard.ZstdDecompressor().decompressobj()
    try:
        content = unpacking.decompress(data)
    except zstandard.ZstdError as error:
        raise DamageError(str(error)) from None
    if not unpacking.eof:
        raise DamageError("a compressed message is incomplete")
    return content


def head_stamp_ns(head: bytes) -> int:
    """The stamp of a message that begins with a header, by its first HEAD_BYTES; 0 for none."""
    if len(head) < HEAD_BYTES:
        return 0
    order = "<" if head[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", head, 4)
    return max(0, int(seconds) * 10**9 + int(nanoseconds))


def full_kind(name: str, encoding: str = "cdr") -> str:
    """A message type as ROS 2 writes it, marked where its messages are not in CDR."""
    kind = name.replace("::", "/") or "unknown type"
    if kind.count("/") == 1:
        kind = kind.replace("/", "/msg/")
    return kind if encoding == "cdr" else f"{kind} in {encoding or 'unknown encoding'}"


class _Record(NamedTuple):
    """A record and where its content lies in a stream."""

    opcode: int
    begin: int
    length: int


class _Where(NamedTuple):
    """A message's bytes: among the records of the chunk that begins there, or in the file."""

    chunk: int
    begin: int
    length: int


class _Part(NamedTuple):
    """Records of a stream from `first` on: of the chunk that begins there in the file, or none."""

    stream: IO[bytes]
    chunk: int
    first: int


class McapBagFile:
    """One file.

    topics: message type by topic.  damage: why some of its bytes cannot be read; empty where all
    can.
    """

    def __init__(self, path: Path) -> None:
        """Raises DamageError where nothing of it can be read."""
        self._path = path
        self._kinds: dict[int, str] = {}
        self._channels: dict[int, Channel] = {}
        self.topics: dict[str, str] = {}
        self.damage = ""
        with path.open("rb") as file:
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                size = path.stat().st_size
                raise DamageError("found no MCAP in it" if size else "the file is empty")
        if not self._take_summary():
            self.index(())
            if self.damage and not self._channels:
                raise DamageError(self.damage)

    def index(self, topics: Collection[str]) -> list[StoredMessage]:
        """The messages of some topics without their bytes, in the order they were written.

        What is damaged is passed over where its length is known.
        """
        self.damage = ""
        found: list[StoredMessage] = []
        with self._path.open("rb") as file:
            for part, record in self._all_records(file):
                try:
                    found += self._take(part, record, topics)
                except Exception as error:  # noqa: BLE001, PERF203  damaged bytes raise anything
                    self.damage = f"the record at byte {record.begin} cannot be read: {error}"
        return found

    @contextmanager
    def opened(self) -> Iterator[Callable[[_Where], bytes]]:
        """Reads the CDR bytes at a message's `where`; DamageError where they are damaged."""
        with self._path.open("rb") as file:
            chunk = lru_cache(KEPT_CHUNKS)(lambda begin: _chunk_records(file, begin))

            def read(where: _Where) -> bytes:
                if where.chunk != NO_CHUNK:
                    return unpacked(chunk(where.chunk)[where.begin : where.begin + where.length])
                file.seek(where.begin)
                return unpacked(file.read(where.length))

            yield read

    def _all_records(self, file: IO[bytes]) -> Iterator[tuple[_Part, _Record]]:
        """Those up to the end of the data, and where they are."""
        for record in self._readable(file, self._path.stat().st_size, len(MCAP0_MAGIC)):
            if record.opcode in (Opcode.DATA_END, Opcode.FOOTER):
                return
            if record.opcode != Opcode.CHUNK:
                yield _Part(file, NO_CHUNK, 0), record
                continue
            try:
                part, end = _part_of_chunk(file, record)
            except DamageError as error:
                self.damage = str(error)
                continue
            for inner in self._readable(part.stream, end, part.first):
                yield part, inner
        self.damage = self.damage or "the file has no end; its recorder did not close it"

    def _readable(self, stream: IO[bytes], end: int, begin: int = 0) -> Iterator[_Record]:
        """The records between two places, up to one that is cut."""
        try:
            yield from _records(stream, begin, end)
        except DamageError as error:
            self.damage = str(error)

    def _take(
        self, part: _Part, record: _Record, topics: Collection[str]
    ) -> Iterator[StoredMessage]:
        """Learn a schema or channel; give a message of a topic that is wanted."""
        reading = ReadDataStream(part.stream)
        if record.opcode == Opcode.SCHEMA:
            self._add_schema(Schema.read(reading))
        elif record.opcode == Opcode.CHANNEL:
            self._add_channel(Channel.read(reading))
        elif record.opcode == Opcode.MESSAGE:
            number, _, received_ns, _ = MESSAGE_HEAD.unpack(reading.read(MESSAGE_HEAD.size))
            channel = self._channels.get(number)
            if channel is None or channel.topic not in topics:
                return
            begin, length = record.begin + MESSAGE_HEAD.size, record.length - MESSAGE_HEAD.size
            head = part.stream.read(min(length, HEAD_BYTES))
            if head.startswith(ZSTD_MAGIC):
                head = unpacked(head + part.stream.read(length - len(head)))
            where = _Where(part.chunk, begin - part.first, length)
            kind, stamp_ns = self._kind(channel), head_stamp_ns(head)
            yield StoredMessage(channel.topic, kind, received_ns, stamp_ns, where)

    def _take_summary(self) -> bool:
        """Whether the file ends with a summary that names all channels."""
        with self._path.open("rb") as file:
            try:
                limited = SeekingReader(file, record_size_limit=MOST_SUMMARY_BYTES)
                summary = limited.get_summary()
            except Exception:  # noqa: BLE001  damaged bytes raise anything
                return False
        statistics = summary.statistics if summary else None
        if summary is None or statistics is None:
            return False
        if len(summary.channels) < statistics.channel_count:
            return False
        for schema in summary.schemas.values():
            self._add_schema(schema)
        for channel in summary.channels.values():
            self._add_channel(channel)
        return True

    def _add_schema(self, schema: Schema) -> None:
        self._kinds[schema.id] = schema.name

    def _add_channel(self, channel: Channel) -> None:
        self._channels[channel.id] = channel
        self.topics.setdefault(channel.topic, self._kind(channel))

    def _kind(self, channel: Channel) -> str:
        return full_kind(self._kinds.get(channel.schema_id, ""), channel.message_encoding)


def _records(stream: IO[bytes], begin: int, end: int) -> Iterator[_Record]:
    """The records between two places; DamageError where one is cut.

    A chunk that is cut comes before that, with the length that is left.  The stream stands where
    the record begins.
    """
    while begin < end:
        stream.seek(begin)
        head = stream.read(RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            msg = f"a record is incomplete at byte {begin}"
            raise DamageError(msg)
        opcode, length = RECORD_HEAD.unpack(head)
        if not opcode:
            msg = f"found no record at byte {begin}"
            raise DamageError(msg)
        begin += RECORD_HEAD.size
        if begin + length > end:
            if opcode == Opcode.CHUNK:
                yield _Record(opcode, begin, end - begin)
            msg = f"a record of {length} bytes at byte {begin} is incomplete"
            raise DamageError(msg)
        yield _Record(opcode, begin, length)
        begin += length


def _part_of_chunk(file: IO[bytes], chunk: _Record) -> tuple[_Part, int]:
    """The records of a chunk and where they end; they are read only where they are compressed."""
    file.seek(chunk.begin + CHUNK_HEAD.size)
    reading = ReadDataStream(file)
    try:
        compression = reading.read_prefixed_string()
        reading.read8()
    except Exception:  # noqa: BLE001  damaged bytes raise anything
        msg = f"the chunk at byte {chunk.begin} is incomplete"
        raise DamageError(msg) from None
    if not compression:
        return _Part(file, chunk.begin, file.tell()), chunk.begin + chunk.length
    data = _chunk_records(file, chunk.begin)
    return _Part(BytesIO(data), chunk.begin, 0), len(data)


def _chunk_records(file: IO[bytes], begin: int) -> bytes:
    """The records of a chunk, unpacked; of one that is cut, what is there of them.

    DamageError where they are not what its checksum says.
    """
    try:
        file.seek(begin)
        chunk = Chunk.read(ReadDataStream(file))
        is_whole = len(chunk.data) >= chunk.uncompressed_size or chunk.compression != ""
        if chunk.compression == "zstd":
            # In one go, nothing of a chunk that is cut would be unpacked.
            unpacking = zstandard.ZstdDecompressor().decompressobj()
            chunk = replace(chunk, compression="", data=unpacking.decompress(chunk.data))
            is_whole = unpacking.eof
        # A checksum is only over all of them.
        stream, size = get_chunk_data_stream(chunk, validate_crc=is_whole)
        return stream.read(size)
    except Exception as error:  # noqa: BLE001  damaged bytes raise anything
        msg = f"the chunk at byte {begin}: {str(error) or type(error).__name__}"
        raise DamageError(msg) from None


class SqliteBagFile:
    """As `McapBagFile`, with what its write-ahead log still holds."""

    def __init__(self, path: Path) -> None:
        """Raises DamageError where nothing of it can be read."""
        self._path = path
        self._topics: dict[int, tuple[str, str]] = {}
        self.damage = ""
        if not path.stat().st_size:
            raise DamageError("the file is empty")
        try:
            with self._connected() as connection:
                rows = connection.execute("SELECT id, name, type, serialization_format FROM topics")
                for number, name, kind, encoding in rows:
                    self._topics[number] = name, full_kind(kind, encoding)
        except sqlite3.Error as error:
            hint = (
                f"; with its {LOG_SUFFIX} file it can only be read in a folder with write access: "
                "copy it there"
            )
            raise DamageError(f"{error}{hint if self._has_log else ''}") from None
        self.topics = dict(self._topics.values())

    def index(self, topics: Collection[str]) -> list[StoredMessage]:
        """As `McapBagFile`, up to the first damage."""
        self.damage = ""
        found = []
        query = f"SELECT id, topic_id, timestamp, substr(data, 1, {HEAD_BYTES}) FROM messages"  # noqa: S608
        try:
            with self._connected() as connection:
                for row, number, received_ns, head in connection.execute(f"{query} ORDER BY id"):
                    name, kind = self._topics.get(number, ("", ""))
                    if name in topics:
                        start = self._read(connection, row) if head[:4] == ZSTD_MAGIC else head
                        stamp_ns = head_stamp_ns(start)
                        found.append(StoredMessage(name, kind, received_ns, stamp_ns, row))
        except (sqlite3.Error, DamageError) as error:
            self.damage = str(error)
        return found

    @contextmanager
    def opened(self) -> Iterator[Callable[[int], bytes]]:
        """As `McapBagFile`."""
        with self._connected() as connection:
            yield lambda row: self._read(connection, row)

    def _read(self, connection: sqlite3.Connection, row: int) -> bytes:
        try:
            found = connection.execute("SELECT data FROM messages WHERE id = ?", (row,)).fetchone()
        except sqlite3.Error as error:
            raise DamageError(str(error)) from None
        return unpacked(bytes(found[0]))

    @contextmanager
    def _connected(self) -> Iterator[sqlite3.Connection]:
        # Without a log nothing is written beside the file, which may be on a read-only disk.
        mode = "mode=ro" if self._has_log else "immutable=1"
        address = f"{self._path.resolve().as_uri()}?{mode}"
        with closing(sqlite3.connect(address, uri=True, check_same_thread=False)) as connection:
            yield connection

    @property
    def _has_log(self) -> bool:
        log = self._path.with_name(self._path.name + LOG_SUFFIX)
        return log.is_file() and log.stat().st_size > 0
