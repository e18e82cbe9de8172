"""Writes a bag as rosbag2 does: a folder with an MCAP file and metadata.yaml, without ROS."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import cast

import zstandard
from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import (
    CompressionFormat,
    CompressionMode,
    StoragePlugin,
    Writer,
    WriterError,
)
from rosbags.rosbag2.storage_mcap import McapWriter

from cmp_tactile_driver.errors import BagWriteError
from cmp_tactile_processing.ros.messages.definitions import MessageDefinition, message_definition
from cmp_tactile_processing.sensor.description import find_sensor_description
from cmp_tactile_processing.sensor.yaml_section import read_yaml
from cmp_tactile_processing.sensor.yaml_text import dump_yaml

SENSOR_FILE = "sensor.yaml"
# rosbags takes level 3, which compresses a camera frame half as fast.
ZSTD_LEVEL = 1


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


class BagWriter:
    """One bag; a context manager, not for several threads at once.

    The same messages give the same bytes.  Whatever cannot be written raises BagWriteError, after
    which the bag may only be closed: what was written before stays, without an index.

    folder: the bag.  path: its MCAP file.
    """

    def __init__(
        self, folder: Path, *, compressed: bool = False, facts: Mapping[str, str] | None = None
    ) -> None:
        """Makes the folder.  compressed: by zstd, which every reader of MCAP undoes by itself.

        facts: are kept in the bag as its custom data.
        """
        self.folder = folder
        self.path = folder / f"{folder.name}.mcap"
        self._topics: dict[str, Connection] = {}
        self._has_failed, self._size = False, 0
        if folder.exists():
            msg = f"{folder}: exists already, expected a new name for the bag"
            raise BagWriteError(msg)
        self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        for name, value in (facts or {}).items():
            self._writer.set_custom_data(name, value)
        if compressed:
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with self._write_errors(folder):
            self._writer.open()
        self._storage = cast("McapWriter", self._writer.storage)
        if compressed:
            self._storage.compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def size(self) -> int:
        """Bytes in the file; what it had last where it is gone."""
        with suppress(OSError):
            self._size = self.path.stat().st_size
        return self._size

    def add_topic(
        self,
        name: str,
        kind: str,
        qos: Sequence[Qos] = (),
        definition: MessageDefinition | None = None,
    ) -> None:
        """Name a topic before its first message; again is no fault.

        kind: such as "sensor_msgs/msg/Image".  qos: profiles of its publishers, for a replay.
        definition: absent for the installed one; raises MessageDefinitionError where there is none.
        """
        if name not in self._topics:
            definition = definition or message_definition(kind)
            self._topics[name] = self._writer.add_connection(
                name,
                kind,
                msgdef=definition.text,
                rihs01=definition.type_hash,
                offered_qos_profiles=qos,
            )

    def write(self, topic: str, log_ns: int, data: bytes) -> None:
        """Add a message to the chunk to come.  log_ns: when it came.  data: CDR."""
        with self._write_errors(self.path):
            self._writer.write(self._topics[topic], log_ns, data)

    def flush(self) -> None:
        """Hand all messages to the operating system."""
        with self._write_errors(self.path):
            if self._storage.chunk.msgs:
                self._storage.close_chunk()
            self._storage.bio.flush()

    def sync(self) -> None:
        """Have the disk keep all, so that it is there even after a power cut."""
        self.flush()
        with self._write_errors(self.path):
            os.fdatasync(self._storage.bio.fileno())

    def close(self) -> None:
        """Write the index and metadata.yaml."""
        if not self._has_failed:
            with self._write_errors(self.path):
                self._writer.close()

    @contextmanager
    def _write_errors(self, place: Path) -> Iterator[None]:
        try:
            yield
        except (OSError, WriterError) as error:
            self._has_failed = True
            with suppress(OSError):
                self._writer.abort()
            msg = f"{place}: cannot be written: {getattr(error, 'strerror', error)}"
            raise BagWriteError(msg) from None
