"""One file of rosbag2's SQLite format, with what its write-ahead log still holds."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from cmp_tactile_driver.bags.files import (
    HEAD_BYTES,
    ZSTD_MAGIC,
    DamageError,
    Place,
    full_kind,
    head_stamp_ns,
    unpacked,
)

LOG_SUFFIX = "-wal"


class SqliteBagFile:
    """As `McapBagFile`; the format does not state how many messages there are."""

    def __init__(self, path: Path) -> None:
        """Raises DamageError where nothing of it can be read."""
        self._path = path
        self._topics: dict[int, tuple[str, str]] = {}
        self.stated: dict[str, int] = {}
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
