"""Writes bags: message by message, or what comes on many threads, through a queue."""

from __future__ import annotations

import os
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import deepcopy
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, cast

import zstandard
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, WriterError
from rosbags.rosbag2.storage_mcap import McapWriter

from cmp_tactile_processing.errors import CmpTactileError, Finding, OutputError, Severity
from cmp_tactile_processing.measured import NS_PER_S
from cmp_tactile_processing.ros.messages.definitions import MessageDefinition, message_definition
from cmp_tactile_processing.sensor.description import find_sensor_description
from cmp_tactile_processing.sensor.yaml_file import read_yaml
from cmp_tactile_processing.sensor.yaml_text import dump_yaml

SENSOR_FILE = "sensor.yaml"
# rosbags takes level 3, which compresses a camera frame half as fast.
ZSTD_LEVEL = 1
SYNC_PERIOD_S = 0.5
MESSAGE_LIMIT = 20_000
FOREVER = QosTime(2**63 // NS_PER_S, 2**63 % NS_PER_S - 1)
LATCHED = Qos(
    history=QosHistory.KEEP_LAST,
    depth=1,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.TRANSIENT_LOCAL,
    deadline=FOREVER,
    lifespan=FOREVER,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=FOREVER,
    avoid_ros_namespace_conventions=False,
)
"""What a player needs to offer late listeners the last message, as rosbag2 writes it."""


def put_sensor_beside(bag: Path, sensor_description: str, sensor_name: str = "") -> None:
    """Copy a description, file or packaged name, into a bag; sensor_name: instead of its name.

    Raises InputError where there is none, OutputError where it cannot be written.
    """
    source = find_sensor_description(sensor_description)
    text = source.read_text(encoding="utf-8")
    if sensor_name:
        text = dump_yaml({**read_yaml(source).content, "name": sensor_name})
    path = bag / SENSOR_FILE
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        msg = f"{path}: cannot be written: {error.strerror}"
        raise OutputError(msg) from None


class BagWriter:
    """One bag; a context manager, not for several threads at once.

    The same messages give the same bytes.  Whatever cannot be written raises OutputError, after
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
            raise OutputError(msg)
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
        definition: absent for the installed one; raises CmpTactileError where there is none.
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
            raise OutputError(msg) from None


class RecorderState(Enum):
    """What a recorder does; FINISHED and FAILED are final."""

    RECORDING = "recording"
    FINISHED = "finished"
    FAILED = "failed"


@dataclass(frozen=True)
class EncodedMessage:
    """What goes to the bag: topic, type and CDR bytes."""

    topic: str
    kind: str
    data: bytes


@dataclass
class Tap:
    """A topic that is recorded.

    encode: makes bytes of a message, on the recorder's thread.  qos: of its publishers.
    size: bytes that the last message took in the bag; the next one waiting counts as much.
    """

    topic: str
    encode: Callable[[Any], EncodedMessage]
    qos: Sequence[Qos] = ()
    size: int = 1000


@dataclass
class RecordingProgress:
    """How far a recording is.

    messages: on the disk, by topic as it is in the bag.  dropped: by topic, because the queue was
    full, they could not be encoded or written or did not come.  problem: the last.  queued_bytes:
    what waits.  first_ns, last_ns: when the first and the latest message came.
    """

    state: RecorderState = RecorderState.RECORDING
    messages: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    problem: str = ""
    size: int = 0
    queued_bytes: int = 0
    first_ns: int = 0
    last_ns: int = 0

    @property
    def duration_s(self) -> float:
        """Time from the first to the latest message."""
        return (self.last_ns - self.first_ns) * 1e-9

    @property
    def is_over(self) -> bool:
        """Whether nothing more is written."""
        return self.state is not RecorderState.RECORDING

    @property
    def has_failed(self) -> bool:
        """Whether it ended early, or its index is missing."""
        return self.state is RecorderState.FAILED

    @property
    def finding(self) -> Finding:
        """What is missing for good, however little; an error where it has failed."""
        dropped = self.dropped.total()
        if self.has_failed:
            return Finding(Severity.ERROR, self.problem)
        text = f"{dropped} messages dropped, last: {self.problem}" if dropped else ""
        return Finding(Severity.WARNING, text)


class BagRecorder:
    """Writes what `put` brings; never waits for the disk in `put`."""

    def __init__(self, writer: BagWriter, queue_bytes: int) -> None:
        """queue_bytes: what may wait; what comes while it is full is dropped, and counted."""
        self._writer = writer
        self._queue: deque[tuple[Tap, int, Any, int]] = deque()
        self._limit_bytes = queue_bytes
        self._condition = threading.Condition()
        self._stopping = False
        self._progress = RecordingProgress()
        self._unsynced: Counter[str] = Counter()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    @property
    def progress(self) -> RecordingProgress:
        """A snapshot; from any thread."""
        with self._condition:
            return deepcopy(self._progress)

    def put(self, tap: Tap, log_ns: int, message: Any) -> None:
        """Hand a message over, which nobody may change any more."""
        size = max(len(getattr(message, "data", ())), tap.size)
        with self._condition:
            progress = self._progress
            if progress.has_failed:
                progress.dropped[tap.topic] += 1
            if progress.is_over or self._stopping:
                return
            queued = progress.queued_bytes + size
            if queued > self._limit_bytes or len(self._queue) >= MESSAGE_LIMIT:
                self._drop(tap, 1, "dropped, because writing is too slow")
                return
            self._queue.append((tap, log_ns, message, size))
            progress.queued_bytes = queued
            self._condition.notify()

    def lost(self, tap: Tap, count: int) -> None:
        """Count messages that did not come as far as `put`."""
        with self._condition:
            self._drop(tap, count, "lost on the way to the recorder")

    def stop(self) -> None:
        """Write what waits, close the bag, and wait for that; may be called more than once."""
        with self._condition:
            self._stopping = True
            self._condition.notify()
        self._thread.join()

    def _drop(self, tap: Tap, count: int, reason: object) -> None:
        self._progress.dropped[tap.topic] += count
        self._progress.problem = f"{tap.topic}: {reason}"

    def _run(self) -> None:
        problem = ""
        for step in (self._write_all, self._writer.close):
            try:
                step()
            except CmpTactileError as error:  # noqa: PERF203  one after the other
                problem = problem or str(error)
            except Exception as error:  # noqa: BLE001  whoever watches must learn of it
                traceback.print_exc()
                problem = problem or f"{type(error).__name__}: {error}"
        with self._condition:
            progress = self._progress
            # What was written last may have found no room on the disk.
            (progress.dropped if problem else progress.messages).update(self._unsynced)
            progress.size = self._writer.size
            progress.state = RecorderState.FAILED if problem else RecorderState.FINISHED
            progress.problem = problem or progress.problem
            progress.dropped.update(tap.topic for tap, *_ in self._queue)
            progress.queued_bytes = 0
            self._queue.clear()

    def _write_all(self) -> None:
        sync_at = time.monotonic() + SYNC_PERIOD_S
        while True:
            with self._condition:
                self._condition.wait_for(
                    lambda: self._queue or self._stopping,
                    max(0.0, sync_at - time.monotonic()),
                )
                item = self._queue.popleft() if self._queue else None
                ends = self._stopping and item is None
            if ends:
                return
            if item is not None:
                self._write(*item)
            if time.monotonic() >= sync_at:
                self._sync()
                sync_at = time.monotonic() + SYNC_PERIOD_S

    def _sync(self) -> None:
        """Close the chunk, and count what is in it."""
        self._writer.sync()
        with self._condition:
            self._progress.size = self._writer.size
            self._progress.messages += self._unsynced
            self._unsynced.clear()

    def _write(self, tap: Tap, log_ns: int, message: Any, size: int) -> None:
        try:
            encoded = tap.encode(message)
            self._writer.add_topic(encoded.topic, encoded.kind, tap.qos)
        except Exception as error:  # noqa: BLE001  one message must not end the recording
            with self._condition:
                self._drop(tap, 1, error)
                self._progress.queued_bytes -= size
            return
        tap.size = len(encoded.data)
        self._unsynced[encoded.topic] += 1
        self._writer.write(encoded.topic, log_ns, encoded.data)
        with self._condition:
            progress = self._progress
            progress.queued_bytes -= size
            progress.first_ns = progress.first_ns or log_ns
            progress.last_ns = max(progress.last_ns, log_ns)
