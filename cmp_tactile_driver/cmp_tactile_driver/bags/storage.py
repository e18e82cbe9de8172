"""Serialised messages of a ROS 2 bag, whole or damaged, without ROS.

A whole bag is read through its index by `rosbags`.  A damaged one (a recorder that was killed, a
disk that was full) has none: its MCAP files are read record by record up to the damage.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Protocol

from mcap.exceptions import EndOfFile
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import Reader

from cmp_tactile_driver.errors import BagError

__all__ = ["BagStorage", "StoredMessage", "open_storage"]

STORAGE_SUFFIXES = (".mcap", ".db3")
MAX_RECORD_BYTES = 2**30


@dataclass(frozen=True)
class StoredMessage:
    """One message as it was recorded: log time in ns, and its CDR bytes."""

    topic: str
    time_ns: int
    data: bytes


class BagStorage(Protocol):
    """A bag to read.

    topics: message type by topic.  loss: what cannot be read, as far as is known; empty for a
    whole bag.  times_ns: log times of the first and the last message of all topics.
    """

    topics: dict[str, str]
    loss: str
    times_ns: tuple[int, int]

    def messages(
        self, topics: Collection[str], first_ns: int = 0, before_ns: int | None = None
    ) -> Iterator[StoredMessage]:
        """The messages of some topics between two log times, in the order of those."""


def open_storage(path: Path) -> BagStorage:
    """Open a bag: a folder, or one .mcap or .db3 file.

    Raises BagError for a path that is absent or no bag, and for a bag of which nothing is left.
    """
    if not path.exists():
        msg = f"{path}: found no such file or folder, expected a ROS 2 bag"
        raise BagError(msg)
    if path.is_file() and path.suffix not in STORAGE_SUFFIXES:
        msg = f"{path}: found a {path.suffix or 'nameless'} file, expected a folder, .mcap or .db3"
        raise BagError(msg)
    try:
        return IndexedBag(path)
    except Exception as error:  # noqa: BLE001  damaged bytes raise anything
        reason = _reason(error)
    if path.is_dir() and not (path / "metadata.yaml").exists():
        reason = "found no metadata.yaml, which a recorder writes at its end"
    files = _mcap_files(path)
    if not files:
        msg = f"{path}: not a readable ROS 2 bag: {reason}"
        raise BagError(msg)
    return DamagedMcap(path, files, reason)


class IndexedBag:
    """A bag that opens as it should; damage further in ends it early, and is then its loss."""

    def __init__(self, path: Path) -> None:
        """Raises whatever `rosbags` does where the bag does not open."""
        self._path = path
        self.loss = ""
        with Reader(path) as reader:
            self.topics = {item.topic: item.msgtype for item in reader.connections}
            # rosbags gives the end as a time after the last message.
            self.times_ns = (reader.start_time, max(reader.start_time, reader.end_time - 1))

    def messages(
        self, topics: Collection[str], first_ns: int = 0, before_ns: int | None = None
    ) -> Iterator[StoredMessage]:
        """The messages of some topics in the order of their log times, up to any damage."""
        with Reader(self._path) as reader:
            chosen = [item for item in reader.connections if item.topic in topics]
            expected = sum(item.msgcount for item in chosen)
            count = 0
            try:
                for connection, time_ns, data in reader.messages(chosen, first_ns, before_ns):
                    count += 1
                    yield StoredMessage(connection.topic, time_ns, bytes(data))
            except Exception as error:  # noqa: BLE001  damaged bytes raise anything
                self.loss = _loss_text(self._path, count, expected, error)


class DamagedMcap:
    """What is left of MCAP files without an index."""

    def __init__(self, path: Path, files: list[Path], reason: str) -> None:
        """Reads the files once for topics and count; BagError where no message is left."""
        self._files = files
        self.topics: dict[str, str] = {}
        count = 0
        times_ns = []
        for file in files:
            for channel, schema, message in _records(file):
                self.topics[channel.topic] = schema.name
                times_ns.append(message.log_time)
                count += 1
        if not count:
            msg = f"{path}: damaged, no message can be read: {reason}"
            raise BagError(msg)
        self.times_ns = (min(times_ns), max(times_ns))
        self.loss = (
            f"{path}: damaged ({reason}); {count} messages can be read, any after them are lost"
        )

    def messages(
        self, topics: Collection[str], first_ns: int = 0, before_ns: int | None = None
    ) -> Iterator[StoredMessage]:
        """The messages of some topics as they were written, up to the damage of each file."""
        for file in self._files:
            for channel, _, message in _records(file):
                if before_ns is not None and message.log_time >= before_ns:
                    continue
                if channel.topic in topics and message.log_time >= first_ns:
                    yield StoredMessage(channel.topic, message.log_time, message.data)


class _WholeReads:
    """A file whose reads give all bytes or raise: `mcap` takes a short read for a short record."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    def read(self, size: int) -> bytes:
        data = self._file.read(size)
        if len(data) < size:
            raise EndOfFile
        return data


def _records(path: Path) -> Iterator[tuple[Channel, Schema, Message]]:
    """Messages with channel and schema, up to the first damage."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with path.open("rb") as file, suppress(Exception):
        stream: IO[bytes] = _WholeReads(file)  # type: ignore[assignment]
        reader = StreamReader(stream, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES)
        for record in reader.records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                yield channel, schemas[channel.schema_id], record


def _mcap_files(path: Path) -> list[Path]:
    if path.is_file():
        return [path] if path.suffix == ".mcap" else []
    files = [file for file in path.glob("*.mcap") if file.is_file()]
    return sorted(files, key=lambda file: (len(file.name), file.name))


def _reason(error: Exception) -> str:
    return str(error).rstrip(".") or type(error).__name__


def _loss_text(path: Path, count: int, expected: int, error: Exception) -> str:
    read = f"{count} of {expected} messages read, the rest is lost"
    return f"{path}: damaged ({_reason(error)}); {read}"
