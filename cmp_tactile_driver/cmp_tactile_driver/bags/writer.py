"""Writes a bag as rosbag2 does: a folder of MCAP files and metadata.yaml, without ROS."""

from __future__ import annotations

import os
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from rosbags.interfaces import Qos, QosDurability
from rosbags.rosbag2.metadata import dump_qos_v9

from cmp_tactile_driver.bags.mcap_writer import McapFile
from cmp_tactile_driver.errors import BagWriteError
from cmp_tactile_processing.cache.files import atomic_path
from cmp_tactile_processing.ros.messages.definitions import MessageDefinition, message_definition
from cmp_tactile_processing.sensor.description import find_sensor_description
from cmp_tactile_processing.sensor.yaml_section import read_yaml
from cmp_tactile_processing.sensor.yaml_text import dump_yaml

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
class BagTopic:
    """A topic of a bag.  kind: its type's name.  qos: profiles of its publishers."""

    name: str
    kind: str
    definition: MessageDefinition
    qos: tuple[Qos, ...] = ()

    @property
    def kept(self) -> int:
        """How many of its last messages somebody who comes late gets; 0 where it is not latched."""
        if not self.qos or any(
            item.durability != QosDurability.TRANSIENT_LOCAL for item in self.qos
        ):
            return 0
        depth = sum(max(1, item.depth) for item in self.qos)
        return min(MOST_KEPT, max(depth, LEAST_KEPT.get(self.name, 0)))


class BagWriter:
    """One bag; not for several threads at once.

    Each file begins with what is latched by then, so that it can be used without those before it.
    Whatever cannot be written raises BagWriteError, after which the bag may only be closed: what
    was written before stays.

    folder: the bag.  counts: messages that are in its files, by topic, without those that a file
    before has already.
    """

    def __init__(
        self, folder: Path, *, compressed: bool = False, split_bytes: int = 0, split_ns: int = 0
    ) -> None:
        """Makes the folder.  compressed: by zstd, which every reader of MCAP undoes by itself.

        A new file begins after split_bytes, and after split_ns of log time; 0 for never.
        """
        self.folder = folder
        self._compressed = compressed
        self._split_bytes, self._split_ns = split_bytes, split_ns
        self._topics: dict[str, BagTopic] = {}
        self._latched: dict[str, deque[tuple[int, bytes]]] = {}
        self._files: list[McapFile] = []
        self._is_open = False
        self._first_ns = self._repeated_bytes = 0
        self.counts: Counter[str] = Counter()
        self._pending: Counter[str] = Counter()
        if folder.exists():
            msg = f"{folder}: exists already, expected a new name for the bag"
            raise BagWriteError(msg)
        with self._write_errors():
            folder.mkdir(parents=True)
            self._open_file()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def file_count(self) -> int:
        """How many files there are."""
        return len(self._files)

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(file.size for file in self._files)

    def add_topic(self, name: str, kind: str, qos: Sequence[Qos] = ()) -> None:
        """Name a topic before its first message; again is no fault.

        kind: such as "sensor_msgs/msg/Image".  qos: profiles of its publishers, for a replay.
        Raises MessageDefinitionError where the message's definition is not installed.
        """
        if name not in self._topics:
            topic = BagTopic(name, kind, message_definition(kind), tuple(qos))
            self._topics[name] = topic
            if topic.kept:
                self._latched[name] = deque(maxlen=topic.kept)

    def write(self, topic: str, log_ns: int, data: bytes, publish_ns: int | None = None) -> None:
        """Add a message.  log_ns: when it came.  data: CDR.  publish_ns: its stamp, if it has.

        A stamp before 1970 cannot be written and counts as none.
        """
        if publish_ns is None or publish_ns < 0:
            publish_ns = log_ns
        # Of a clock that was set back, the file's time counts from there.
        self._first_ns = min(self._first_ns, log_ns)
        if self._is_full(log_ns):
            self.split()
        if not self._first_ns:
            self._first_ns = log_ns
            for name, messages in self._latched.items():
                for stamp_ns, kept in messages:
                    self._put(name, log_ns, stamp_ns, kept)
            self._repeated_bytes = self._files[-1].size
        self._put(topic, log_ns, publish_ns, data)
        self._pending[topic] += 1
        if topic in self._latched:
            message = publish_ns, data
            with suppress(ValueError):  # sent once more
                self._latched[topic].remove(message)
            self._latched[topic].append(message)
        if self._files[-1].chunk_is_full:
            self._flush(self._files[-1].flush)

    def sync(self) -> None:
        """Have the disk keep all, so that it is there even after a power cut."""
        self._flush(self._files[-1].sync)

    def split(self) -> None:
        """Begin a new file."""
        self._close_file()
        with self._write_errors():
            self._open_file()

    def close(self) -> None:
        """Write the index and metadata.yaml."""
        try:
            self._close_file()
        finally:
            with self._write_errors():
                write_metadata(self.folder, self._files, list(self._topics.values()))

    @contextmanager
    def _write_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            place = self._files[-1].path if self._is_open else self.folder
            msg = f"{place}: cannot be written: {error.strerror}"
            raise BagWriteError(msg) from None

    def _is_full(self, log_ns: int) -> bool:
        size = self._files[-1].size - self._repeated_bytes
        if self._split_bytes and size >= self._split_bytes:
            return True
        passed = log_ns - self._first_ns if self._first_ns else 0
        return bool(self._split_ns and passed >= self._split_ns)

    def _open_file(self) -> None:
        path = self.folder / f"{self.folder.name}_{len(self._files)}.mcap"
        self._files.append(McapFile(path, compressed=self._compressed))
        self._is_open = True
        self._first_ns = self._repeated_bytes = 0

    def _put(self, topic: str, log_ns: int, publish_ns: int, data: bytes) -> None:
        item = self._topics[topic]
        self._files[-1].add_topic(topic, item.kind, item.definition.text, item.qos)
        self._files[-1].write(topic, log_ns, publish_ns, data)

    def _flush(self, flush: Callable[[], None]) -> None:
        pending, self._pending = self._pending, Counter()
        with self._write_errors():
            flush()
        self.counts += pending

    def _close_file(self) -> None:
        # There is none where no new one could be begun.
        if not self._is_open:
            return
        try:
            try:
                self._flush(self._files[-1].flush)
            finally:
                with self._write_errors():
                    self._files[-1].close()
        finally:
            self._is_open = False


def write_metadata(folder: Path, files: Sequence[McapFile], topics: Sequence[BagTopic]) -> None:
    """Write metadata.yaml of a bag with these files, which are closed.  May raise OSError."""
    counts = sum((file.counts for file in files), Counter[str]())
    begins, ends = zip(*(file.times_ns for file in files), strict=True)
    information = {
        "version": METADATA_VERSION,
        "storage_identifier": "mcap",
        **_span(counts, (min(begins), max(ends))),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.kind,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [dict(item) for item in dump_qos_v9(list(topic.qos))],
                    "type_description_hash": topic.definition.type_hash,
                },
                "message_count": counts[topic.name],
            }
            for topic in topics
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.path.name for file in files],
        "files": [{"path": f.path.name, **_span(f.counts, f.times_ns)} for f in files],
        "custom_data": None,
        "ros_distro": os.environ.get("ROS_DISTRO", ""),
    }
    text = yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False)
    with atomic_path(folder / "metadata.yaml") as beside:
        beside.write_text(text, encoding="utf-8")


def _span(counts: Counter[str], times_ns: tuple[int, int]) -> dict[str, Any]:
    """Number and times of messages as metadata.yaml has them."""
    first, last = times_ns
    count = counts.total()
    return {
        "duration": {"nanoseconds": last - first if count else 0},
        "starting_time": {"nanoseconds_since_epoch": first},
        "message_count": count,
    }
