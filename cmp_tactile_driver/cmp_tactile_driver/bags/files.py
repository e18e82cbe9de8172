"""What files of bags have in common, and files of rosbag2's SQLite format."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zstandard

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
HEAD_BYTES = 12
"""Of a message: what names the encoding, and the stamp of a header that it begins with."""


class DamageError(Exception):
    """Bytes that are no message, no file of its format, or are not there."""


@dataclass(frozen=True)
class Place:
    """Where a message lies.

    time_ns: when it was received.  stamp_ns: of its header, if its type begins with one; 0 where it
    has none.  where: for the reading of its file, which is the `file`th of its bag.
    """

    topic: str
    kind: str
    time_ns: int
    stamp_ns: int
    where: Any
    file: int = 0


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
    """The stamp in the first HEAD_BYTES of a message that begins with a header; 0 for none."""
    if len(head) < HEAD_BYTES:
        return 0
    order = "<" if head[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", head, 4)
    return max(0, int(seconds) * 10**9 + int(nanoseconds))


def full_kind(name: str, encoding: str = "cdr") -> str:
    """A message type as ROS 2 writes it, marked where its messages are not in CDR."""
    package, _, short = name.replace("::", "/").partition("/")
    kind = f"{package}/msg/{short}" if short and "/" not in short else f"{package}/{short}"
    return kind if encoding == "cdr" else f"{kind} in {encoding or 'unknown encoding'}"


LOG_SUFFIX = "-wal"


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

    def places(self, topics: Collection[str]) -> list[Place]:
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
                        stamp_ns = head_stamp_ns(start[:HEAD_BYTES])
                        found.append(Place(name, kind, received_ns, stamp_ns, row))
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
