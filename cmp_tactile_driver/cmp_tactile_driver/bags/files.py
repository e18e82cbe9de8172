"""Files of bags: MCAP with or without an end, by `mcap`; rosbag2's SQLite files, by `rosbags`."""

from __future__ import annotations

import shlex
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby, islice
from operator import itemgetter
from pathlib import Path
from typing import IO, Any

import zstandard
from mcap.exceptions import EndOfFile
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC
from rosbags.rosbag2 import Reader
from rosbags.serde import SerdeError

from cmp_tactile_processing.errors import FrameError, FrameSourceError
from cmp_tactile_processing.measured import NS_PER_S
from cmp_tactile_processing.ros.messages.definitions import simulation_typestore

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
# What rosbags raises for bytes that are no message of their type.
# KeyError where a damaged schema names a type that nobody knows.
BAD_MESSAGE = (SerdeError, ValueError, LookupError, OverflowError)
HEAD_BYTES = 12
"""Of a message: what names the encoding, and the stamp of a header that it begins with."""

# One in use, and those that others overlap in time.
KEPT_CHUNKS = 4

Found = Iterator[tuple[str, int, Any, bytes]]
"""Topic, time of receipt, place in the file and bytes of messages."""


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

    def decode(self) -> Any:
        """The message in its bytes; FrameError where they are none of its type."""
        try:
            return simulation_typestore().deserialize_cdr(self.data, self.kind)
        except BAD_MESSAGE as error:
            msg = f"not a {self.kind}: {error}"
            raise FrameError(msg) from None


def unpacked(data: bytes) -> bytes:
    """A message that rosbag2 may have compressed by itself; FrameSourceError where it cannot be."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    # Takes frames that do not state how long their content is, too.
    unpacking = zstandard.ZstdDecompressor().decompressobj()
    try:
        content = unpacking.decompress(data)
    except zstandard.ZstdError as error:
        raise FrameSourceError(str(error)) from None
    if not unpacking.eof:
        raise FrameSourceError("a compressed message is incomplete")
    return content


def head_stamp_ns(message: bytes) -> int:
    """The stamp of a message that begins with a header; 0 for none."""
    head = unpacked(message)
    if len(head) < HEAD_BYTES:
        return 0
    order = "<" if head[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", head, 4)
    return max(0, int(seconds) * NS_PER_S + int(nanoseconds))


def full_kind(name: str, encoding: str = "cdr") -> str:
    """A message type as ROS 2 writes it, marked where its messages are not in CDR."""
    kind = name.replace("::", "/") or "unknown type"
    if kind.count("/") == 1:
        kind = kind.replace("/", "/msg/")
    return kind if encoding == "cdr" else f"{kind} in {encoding or 'unknown encoding'}"


class BagFile(ABC):
    """One file of a bag.

    topics: message type by topic.  damage: what of it cannot be read; empty where all can.
    """

    def __init__(self, path: Path) -> None:
        """Raises FrameSourceError where nothing of it can be read."""
        self.path = path
        self.topics: dict[str, str] = {}
        self.damage = ""
        if not path.stat().st_size:
            raise FrameSourceError("the file is empty")

    def index(self, topics: Collection[str]) -> list[StoredMessage]:
        """The messages of some topics without their bytes, in the order of the file.

        What is damaged is left out.
        """
        self.damage = ""
        found = []
        for topic, received_ns, where, data in self._messages(topics):
            try:
                stamp_ns = head_stamp_ns(data)
            except FrameSourceError as error:
                self.damage = str(error)
                continue
            found.append(StoredMessage(topic, self.topics[topic], received_ns, stamp_ns, where))
        return found

    @abstractmethod
    def _messages(self, topics: Collection[str]) -> Found:
        """The messages that can be read; sets `damage` where some cannot."""

    @abstractmethod
    def opened(self) -> AbstractContextManager[Callable[[Any], bytes]]:
        """Reads the bytes at a message's `where`, as they are in the file.

        Whatever it raises means that they are damaged.
        """


class McapBagFile(BagFile):
    """An MCAP file: messages in the order in which they were written."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._size = path.stat().st_size
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        with path.open("rb") as file:
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise FrameSourceError("found no MCAP in it")
            self._take_summary(file)
        if not self.topics:
            self.index(())
        if self.damage and not self.topics:
            raise FrameSourceError(self.damage)

    @contextmanager
    def opened(self) -> Iterator[Callable[[tuple[int, int]], bytes]]:
        """As that of a `BagFile`."""
        with self.path.open("rb") as file:

            @lru_cache(KEPT_CHUNKS)
            def parts(begin: int) -> list[Any]:
                _, record = next(self._records(file, begin))
                return _parts(record, validate_crc=True)

            yield lambda where: bytes(parts(where[0])[where[1]].data)

    def _messages(self, topics: Collection[str]) -> Found:
        with self.path.open("rb") as file:
            for begin, record in self._records_in_order(file):
                try:
                    parts = _parts(record)
                except Exception as error:  # noqa: BLE001  damaged bytes raise anything
                    self._note_damage(f"the chunk at byte {begin}", error)
                    continue
                for number, part in enumerate(parts):
                    if isinstance(part, Message):
                        channel = self._channels.get(part.channel_id)
                        if channel is not None and channel.topic in topics:
                            yield channel.topic, part.log_time, (begin, number), part.data
                    else:
                        self._learn(part)

    def _records_in_order(self, file: IO[bytes]) -> Iterator[tuple[int, McapRecord]]:
        """Records up to the end of the data, or to where the file is damaged."""
        begin = 0
        try:
            for begin, record in self._records(file):
                if isinstance(record, DataEnd):
                    return
                yield begin, record
        except EndOfFile:
            self.damage = self.damage or "the file has no end; its recorder did not close it"
        except Exception as error:  # noqa: BLE001  damaged bytes raise anything
            self._note_damage(f"after byte {begin}", error)

    def _records(self, file: IO[bytes], begin: int = 0) -> Iterator[tuple[int, McapRecord]]:
        """Chunks, and what lies between them, from a byte on, and where each begins."""
        file.seek(begin)
        limit = self._size
        is_first = begin == 0
        reading = StreamReader(file, not is_first, emit_chunks=True, record_size_limit=limit)
        for record in reading.records:
            yield begin, record
            begin = file.tell()

    def _note_damage(self, place: str, error: Exception) -> None:
        self.damage = f'{place}: {error}; "mcap recover" may save more'

    def _learn(self, record: McapRecord) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
            schema = self._schemas.get(record.schema_id)
            kind = full_kind(schema.name if schema else "", record.message_encoding)
            self.topics.setdefault(record.topic, kind)

    def _take_summary(self, file: IO[bytes]) -> None:
        """Learn the topics at the end of the file, if it names all."""
        file.seek(0)
        try:
            summary = SeekingReader(file, record_size_limit=self._size).get_summary()
        except Exception:  # noqa: BLE001  damaged bytes raise anything
            return
        statistics = summary and summary.statistics
        if summary and statistics and len(summary.channels) >= statistics.channel_count:
            for record in (*summary.schemas.values(), *summary.channels.values()):
                self._learn(record)


def _parts(record: McapRecord, *, validate_crc: bool = False) -> list[McapRecord]:
    """The records of a chunk; may raise anything where it is damaged."""
    return breakup_chunk(record, validate_crc) if isinstance(record, Chunk) else [record]


class SqliteBagFile(BagFile):
    """A .db3 file: messages in the order in which they were received.

    What a recorder that was killed left in its write-ahead log is not read.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        log = path.with_name(path.name + "-wal")
        has_log = log.is_file() and log.stat().st_size > 0
        self._lost = (
            f"its write-ahead log {log.name} is not read; to store what it holds in the bag: "
            f"sqlite3 {shlex.quote(str(path))} 'PRAGMA wal_checkpoint(TRUNCATE)'"
            if has_log
            else ""
        )
        try:
            with self._reader() as reader:
                for item in reader.connections:
                    encoding = getattr(item.ext, "serialization_format", "cdr")
                    self.topics[item.topic] = full_kind(item.msgtype, encoding)
        except Exception as error:  # noqa: BLE001  damaged bytes raise anything
            raise FrameSourceError("; ".join(filter(None, (str(error), self._lost)))) from None

    @contextmanager
    def opened(self) -> Iterator[Callable[[tuple[frozenset[int], int, int]], bytes]]:
        """As that of a `BagFile`."""
        with self._reader() as reader:

            def read(where: tuple[frozenset[int], int, int]) -> bytes:
                ids, time_ns, number = where
                wanted = [item for item in reader.connections if item.id in ids]
                at_once = reader.messages(wanted, time_ns, time_ns + 1)
                return bytes(next(islice(at_once, number, None))[2])

            yield read

    def _messages(self, topics: Collection[str]) -> Found:
        self.damage = self._lost
        try:
            with self._reader() as reader:
                wanted = [item for item in reader.connections if item.topic in topics]
                ids = frozenset(item.id for item in wanted)
                found = reader.messages(wanted)
                for time_ns, at_once in groupby(found, key=itemgetter(1)):
                    for number, (item, _, data) in enumerate(at_once):
                        yield item.topic, time_ns, (ids, time_ns, number), bytes(data)
        except Exception as error:  # noqa: BLE001  damaged bytes raise anything
            self.damage = str(error)

    @contextmanager
    def _reader(self) -> Iterator[Any]:
        # Reader itself wants the name in lower case.
        reader = Reader.STORAGE_PLUGINS[".db3"](self.path)
        reader.open()
        with closing(reader):
            yield reader
