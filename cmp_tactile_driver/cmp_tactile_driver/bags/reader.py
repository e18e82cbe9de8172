"""Messages of a ROS 2 bag, whole or damaged, and the camera frames among them, without ROS.

A whole bag is read through its index by `rosbags`.  A damaged one (a recorder that was killed, a
disk that was full) has none: its MCAP files are read record by record up to the damage.  Frames are
sensor_msgs Image and CompressedImage, with CameraInfo.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np
from mcap.exceptions import EndOfFile
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray
from rosbags.rosbag2 import Reader
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from cmp_tactile_driver.errors import BagError, WrongSizeError
from cmp_tactile_driver.sources.frames import MOST_WRONG_SIZES, ImageSize, SourceHealth, size_text
from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.image.compressed import decode_compressed
from cmp_tactile_processing.image.raw import BitDepth, decode_raw
from cmp_tactile_processing.ros.messages.making import CAMERA_INFO, whole_frame_info
from cmp_tactile_processing.sensor.description import SensorDescription

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


@dataclass(frozen=True)
class RecordedFrame:
    """A camera frame.

    time_ns: when it was recorded, which gives the timing.  stamp_ns, frame_id: of its header.
    image: (H, W) grey or (H, W, 3) BGR, uint8.  has_camera_info: whether its recording has
    camera infos, too.
    """

    time_ns: int
    stamp_ns: int
    frame_id: str
    image: NDArray[np.uint8]
    has_camera_info: bool = False


@dataclass(frozen=True)
class RecordedCameraInfo:
    """A sensor_msgs/CameraInfo, as the CDR bytes that were recorded."""

    time_ns: int
    data: bytes


@dataclass(frozen=True)
class RecordedCalibration:
    """What a sensor_msgs/CameraInfo on `topic` says.  K (3, 3), px: all 0 if not calibrated."""

    topic: str
    width: int
    height: int
    K: NDArray[np.float64]
    D: NDArray[np.float64]


RecordedMessage = RecordedFrame | RecordedCameraInfo


@dataclass(frozen=True)
class TimeSpan:
    """A part of a recording, in s from its beginning: from `start` on, before `end`."""

    start: float = 0.0
    end: float = math.inf

    def in_ns(self, begin_ns: int) -> tuple[int, int | None]:
        """The same as times, the end None where there is none.  begin_ns: of the recording."""
        first = begin_ns + round(self.start * 1e9)
        return first, None if math.isinf(self.end) else begin_ns + round(self.end * 1e9)


WHOLE = TimeSpan()


# What rounding in a description file may change; another camera differs by more.
MATRIX_TOLERANCE_PX = 0.1
DISTORTION_TOLERANCE = 1e-3


def calibration_mismatch(found: RecordedCalibration | None, sensor: SensorDescription) -> str:
    """The first difference in one line: topic, field, found, expected; empty where they agree.

    Size, K and D are compared; K and D only where the camera of the recording is calibrated and
    the sensor has one camera for the whole frame.
    """
    if found is None:
        return ""
    difference = _size_difference(found, sensor) or _lens_difference(found, sensor)
    if not difference:
        return ""
    return f"{found.topic}: {difference}: is {sensor.name} the description of this sensor?"


def _size_difference(found: RecordedCalibration, sensor: SensorDescription) -> str:
    for field in ("width", "height"):
        value, expected = getattr(found, field), getattr(sensor.image, field)
        if value != expected:
            return f"{field}: found {value}, expected {expected}"
    return ""


def _lens_difference(found: RecordedCalibration, sensor: SensorDescription) -> str:
    camera = sensor.camera
    if camera is None or not found.K.any():
        return ""
    K = whole_frame_info(sensor).K
    if not np.allclose(found.K, K, rtol=0, atol=MATRIX_TOLERANCE_PX):
        return f"K: found {_numbers(found.K)}, expected {_numbers(K)}"
    expected = np.array(camera.distortion)
    length = max(found.D.size, expected.size)
    # Coefficients that are left out are 0.
    D, D_expected = (np.pad(D, (0, length - D.size)) for D in (found.D, expected))
    if not np.allclose(D, D_expected, rtol=0, atol=DISTORTION_TOLERANCE):
        return f"D: found {_numbers(found.D)}, expected {_numbers(expected)}"
    return ""


def _numbers(values: NDArray[np.float64]) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values.ravel()) + "]"


IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
# What rosbags raises for bytes that are no message of their type.
BAD_MESSAGE = (SerdeError, ValueError, IndexError, OverflowError)


class BagReader:
    """Frames of one image topic of a bag, and the camera infos beside it.

    image_topic: where the frames come from.  Where these have 16 bits a pixel, all are read ahead
    once for the bits that they use.
    """

    def __init__(self, path: Path, topic: str = "", expected_size: ImageSize | None = None) -> None:
        """topic: empty for the only image topic.  expected_size: absent for the first frame's.

        Raises BagError for a bag that cannot be read or has no such image topic.
        """
        self._path, self.name = path, str(path)
        self._storage = open_storage(path)
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        self.image_topic = _choose_topic(path, self._storage.topics, topic)
        self._info_topic = _info_topic(self._storage.topics, self.image_topic)
        self._depth = BitDepth(f"{path}: {self.image_topic}", look_ahead=self._used_bits)
        self._given_size = expected_size
        self._expected_size = expected_size
        self._frame_health = SourceHealth()
        self._info_health = SourceHealth()

    @property
    def has_camera_info(self) -> bool:
        """Whether the bag has camera infos of this camera."""
        return self._info_topic is not None

    @property
    def loss(self) -> str:
        """What of a damaged bag cannot be read; empty for a whole one."""
        return self._storage.loss

    @property
    def health(self) -> SourceHealth:
        """Frames that could not be used in the last reading, and what a damaged bag lost."""
        problem = self._frame_health.problem or self._info_health.problem or self.loss
        return SourceHealth(self._frame_health.bad_frames, problem)

    @property
    def duration(self) -> float:
        """Time from the first to the last message of the bag, s."""
        first_ns, last_ns = self._storage.times_ns
        return (last_ns - first_ns) * 1e-9

    def calibration(self) -> RecordedCalibration | None:
        """What the first camera info says; None where there is none that can be read."""
        if self._info_topic is None:
            return None
        for stored in self._storage.messages([self._info_topic]):
            try:
                info: Any = self._typestore.deserialize_cdr(stored.data, CAMERA_INFO)
            except BAD_MESSAGE:
                continue
            K = np.asarray(info.k, np.float64).reshape(3, 3)
            D = np.asarray(info.d, np.float64)
            return RecordedCalibration(stored.topic, info.width, info.height, K, D)
        return None

    def frames(self) -> Iterator[RecordedFrame]:
        """The frames alone; as `messages`."""
        return (item for item in self.messages() if isinstance(item, RecordedFrame))

    def messages(self, span: TimeSpan = WHOLE) -> Iterator[RecordedMessage]:
        """Frames and camera infos in the order of their recording.

        A frame of an encoding, size, stamp or content that cannot be used is skipped and counted, a
        camera info that cannot be read is skipped.
        Raises BagError where there is no good frame, unless the span has none at all.
        """
        self._frame_health = self._info_health = SourceHealth()
        self._expected_size = self._given_size
        topics = [topic for topic in (self.image_topic, self._info_topic) if topic]
        count = wrong_sizes = 0
        times = span.in_ns(self._storage.times_ns[0])
        for stored in self._storage.messages(topics, *times):
            if stored.topic == self._info_topic:
                if self._is_camera_info(stored):
                    yield RecordedCameraInfo(stored.time_ns, stored.data)
                continue
            try:
                frame = self._read_frame(stored)
            except FrameError as error:
                where = f"{self._path}: {self.image_topic} at {stored.time_ns} ns"
                self._frame_health = self._frame_health.with_bad_frame(f"{where}: {error}")
                wrong_sizes += isinstance(error, WrongSizeError)
                if wrong_sizes == MOST_WRONG_SIZES and not count:
                    break
                continue
            count += 1
            yield frame
        if not count and (span == WHOLE or self._frame_health.bad_frames):
            reason = self.health.problem or "the topic is empty"
            msg = f"{self._path}: {self.image_topic}: no frame can be used: {reason}"
            raise BagError(msg)

    def _is_camera_info(self, stored: StoredMessage) -> bool:
        """Whether others will be able to read it, as they get the bytes that are there."""
        try:
            self._typestore.deserialize_cdr(stored.data, CAMERA_INFO)
        except BAD_MESSAGE as error:
            text = f"{self._path}: {stored.topic} at {stored.time_ns} ns: not a {CAMERA_INFO}"
            self._info_health = self._info_health.with_bad_frame(f"{text}: {error}")
            return False
        return True

    def _used_bits(self) -> int:
        depth = BitDepth(say=str)
        for stored in self._storage.messages([self.image_topic]):
            with suppress(FrameError):
                self._decode(self._read_message(stored), depth)
        return depth.bits

    def _read_message(self, stored: StoredMessage) -> Any:
        kind = self._storage.topics[stored.topic]
        try:
            return self._typestore.deserialize_cdr(stored.data, kind)
        except BAD_MESSAGE as error:
            msg = f"not a {kind}: {error}"
            raise FrameError(msg) from None

    def _read_frame(self, stored: StoredMessage) -> RecordedFrame:
        message = self._read_message(stored)
        if not hasattr(message, "format"):
            # Before it is converted: a wrong one may be large.
            self._check_size((message.width, message.height))
        image = self._decode(message, self._depth)
        size = (image.shape[1], image.shape[0])
        self._check_size(size)
        self._expected_size = size
        stamp = message.header.stamp
        stamp_ns = stamp.sec * 10**9 + stamp.nanosec
        if stamp_ns < 0:
            msg = f"header.stamp: found {stamp.sec} s, expected 0 or more"
            raise FrameError(msg)
        frame_id = message.header.frame_id
        return RecordedFrame(stored.time_ns, stamp_ns, frame_id, image, self.has_camera_info)

    def _check_size(self, size: ImageSize) -> None:
        if self._expected_size not in (None, size):
            msg = f"found {size_text(size)}, expected {size_text(self._expected_size)}"
            raise WrongSizeError(msg)

    def _decode(self, message: Any, depth: BitDepth) -> NDArray[np.uint8]:
        data = np.asarray(message.data, np.uint8)
        if hasattr(message, "format"):
            return decode_compressed(message.format, data, depth)
        return decode_raw(
            (message.width, message.height),
            message.encoding,
            message.step,
            data,
            big_endian=bool(message.is_bigendian),
            depth=depth,
        )


def _choose_topic(path: Path, topics: dict[str, str], wanted: str) -> str:
    images = sorted(name for name, kind in topics.items() if kind in (IMAGE, COMPRESSED_IMAGE))
    found = ", ".join(f"{name} ({kind})" for name, kind in sorted(topics.items())) or "none"
    if wanted:
        if wanted in images:
            return wanted
        msg = f"{path}: found no images on {wanted!r}; topics: {found}"
        raise BagError(msg)
    if not images:
        msg = f"{path}: found no topic of type {IMAGE} or {COMPRESSED_IMAGE}; topics: {found}"
        raise BagError(msg)
    camera = [name for name in images if name.removesuffix("/compressed").endswith("image_raw")]
    # A recording of a running sensor holds its views and overlays too; the camera's is outermost.
    camera.sort(key=lambda name: (name.removesuffix("/compressed").count("/"), name))
    bases = {name.removesuffix("/compressed") for name in camera}
    outermost = [base for base in bases if base.count("/") == min(b.count("/") for b in bases)]
    if len(images) == 1:
        return images[0]
    if len(outermost) == 1:
        return next(name for name in camera if name.removesuffix("/compressed") == outermost[0])
    msg = f"{path}: found several image topics, name one of: {', '.join(images)}"
    raise BagError(msg)


def _info_topic(topics: dict[str, str], image_topic: str) -> str | None:
    """The camera info in the same namespace as the images (`a/image_raw` -> `a/camera_info`)."""
    namespace = image_topic.removesuffix("/compressed").rpartition("/")[0]
    name = f"{namespace}/camera_info"
    return name if topics.get(name) == CAMERA_INFO else None
