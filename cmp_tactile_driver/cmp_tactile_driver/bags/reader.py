"""The frames or surfaces of a ROS 2 bag, in order of their stamps, without ROS.

Frames are sensor_msgs Image and CompressedImage, with CameraInfo; surfaces stand in their place
where a sensor has measured its markers itself.  Camera infos are compared with a description.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.bags.files import StoredMessage
from cmp_tactile_driver.bags.storage import BagStorage
from cmp_tactile_driver.bags.timeline import DEFAULT_FRAME_RATE, WHOLE, Timeline, TimeSpan, timeline
from cmp_tactile_driver.sources.frames import MOST_WRONG_SIZES, ImageSize, SourceHealth, size_text
from cmp_tactile_processing.errors import FrameError, FrameSourceError, InputError
from cmp_tactile_processing.geometry.rectification import ROS_MODEL, ViewCameraInfo
from cmp_tactile_processing.image.encodings import COMPRESSED, BitDepth
from cmp_tactile_processing.measured import NS_PER_S, GridShape, Surface
from cmp_tactile_processing.ros.messages.making import CAMERA_INFO, SURFACE, whole_frame_info
from cmp_tactile_processing.ros.messages.reading import (
    camera_info_from_msg,
    image_camera_info_from_msg,
    image_from_msg,
    surface_from_msg,
)
from cmp_tactile_processing.sensor.description import SensorDescription

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
FRAMES_FOR_RATE = 20
# What rounding in a description file may change; another camera differs by more.
MATRIX_TOLERANCE_PX = 0.1
DISTORTION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class RecordedFrame:
    """A camera frame, or a surface in its place, where a sensor has measured its markers itself.

    time_s: from the recording's first frame, which gives the timing.  stamp_ns, frame_id: of its
    header.  time_ns: its stamp; when it was received where it has none.  content: (H, W) grey or
    (H, W, 3) BGR, uint8, or the surface.  has_camera_info: whether its recording has camera infos.
    """

    time_s: float
    time_ns: int
    stamp_ns: int
    frame_id: str
    content: NDArray[np.uint8] | Surface
    has_camera_info: bool = False

    @property
    def is_surface(self) -> bool:
        """Whether there is no image."""
        return isinstance(self.content, Surface)

    @property
    def image(self) -> NDArray[np.uint8]:
        """The content of a camera frame."""
        return cast("NDArray[np.uint8]", self.content)


@dataclass(frozen=True)
class RecordedCameraInfo:
    """A sensor_msgs/CameraInfo, as the CDR bytes that were recorded; times as of a frame."""

    time_s: float
    time_ns: int
    data: bytes


RecordedMessage = RecordedFrame | RecordedCameraInfo


class BagReader:
    """Frames of one image topic of a bag, and the camera infos beside it; or its surfaces.

    image_topic: where the frames, or surfaces, come from.  Where frames have 16 bits a pixel, all
    are read ahead once for the bits that they use.
    """

    codec = ""

    def __init__(
        self,
        path: Path,
        topic: str = "",
        expected_size: ImageSize | None = None,
        shape: GridShape | None = None,
        namespace: str = "",
    ) -> None:
        """topic: empty for the only image topic.  expected_size: absent for the first frame's.

        shape: of surfaces, which are read where the bag has no images, or topic names them; absent
        where only frames are of use.  namespace: of the sensor, in a bag with frames of several.
        Raises FrameSourceError for a bag that cannot be read or has no such topic.
        """
        self._path, self.name = path, str(path)
        self._storage = BagStorage(path)
        self._shape = shape
        topic = topic and f"/{topic.strip('/')}"
        topics = of_one_sensor(_topics_with_frames(self._storage, topic), namespace)
        self.image_topic = _choose_topic(path, topics, topic, surfaces=bool(shape))
        self._info_topic = _info_topic(self._storage.topics, self.image_topic)
        self._depth = BitDepth(f"{path}: {self.image_topic}", look_ahead=self._used_bits)
        self._given_size = expected_size
        self._expected_size, self._wrong_sizes = expected_size, 0
        self._health = SourceHealth()

    @property
    def has_camera_info(self) -> bool:
        """Whether the bag has camera infos of this camera."""
        return self._info_topic is not None

    @property
    def of_surfaces(self) -> bool:
        """Whether surfaces are read, in place of frames."""
        return self._storage.topics[self.image_topic] == SURFACE

    @property
    def health(self) -> SourceHealth:
        """Frames that could not be used in the last reading, and what a damaged bag lost."""
        return replace(self._health, problem=self._health.problem or self._storage.loss)

    @property
    def duration(self) -> float:
        """Time of the last message, s from the first frame."""
        return self._timeline.duration

    @cached_property
    def frame_rate(self) -> float:
        """Of its first frames, Hz; FrameSourceError where none is good."""
        times_s = [frame.time_s for frame in islice(self.frames(), FRAMES_FOR_RATE)]
        interval_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
        return min(1 / interval_s, 1000.0) if interval_s > 0 else DEFAULT_FRAME_RATE

    @property
    def gaps(self) -> str:
        """Times that are skipped, in one line; empty for none."""
        return self._timeline.gaps

    @cached_property
    def _timeline(self) -> Timeline:
        topics = [topic for topic in (self.image_topic, self._info_topic) if topic]
        return timeline(self._storage.index(topics), self.image_topic)

    def calibration_mismatch(self, sensor: SensorDescription) -> str:
        """In what the first camera info that can be read differs from a description; or empty.

        Where the chip is binned or cut, some drivers state size or K of the image, not of the chip.
        """
        messages = [item for item in self._timeline.messages if item.topic == self._info_topic]
        for stored in self._storage.read(messages):
            with suppress(FrameError):
                message = stored.decode()
                infos = camera_info_from_msg(message), image_camera_info_from_msg(message)
                readings = [replace(sized, K=info.K) for sized in infos for info in infos]
                found = [calibration_mismatch(stored.topic, info, sensor) for info in readings]
                return found[0] if all(found) else ""
        return ""

    def frames(self, span: TimeSpan = WHOLE) -> Iterator[RecordedFrame]:
        """As `messages`, without camera infos."""
        return (item for item in self.messages(span) if isinstance(item, RecordedFrame))

    def messages(self, span: TimeSpan = WHOLE) -> Iterator[RecordedMessage]:
        """Frames, or surfaces, and camera infos in the order of their stamps.

        A frame of an encoding, size, stamp or content that cannot be used is skipped and counted, a
        camera info that cannot be read is skipped.
        Raises FrameSourceError where there is no good frame, unless the span has none at all.
        """
        self._health = SourceHealth()
        self._expected_size = self._given_size
        count = self._wrong_sizes = 0
        for stored in self._storage.read(self._timeline.part(span)):
            if stored.topic == self._info_topic:
                if self._is_camera_info(stored):
                    yield RecordedCameraInfo(stored.time_s, stored.moment_ns, stored.data)
                continue
            try:
                frame = self._read_frame(stored)
            except (FrameError, InputError) as error:
                where = f"{self._path}: {self.image_topic} at {stored.time_ns} ns"
                self._health = self._health.with_bad_frame(f"{where}: {error}")
                if self._wrong_sizes == MOST_WRONG_SIZES and not count:
                    break
                continue
            count += 1
            yield frame
        if not count and (span == WHOLE or self._health.bad_frames):
            reason = self.health.problem.replace(f"{self._path}: ", "") or "the topic is empty"
            msg = f"{self._path}: {self.image_topic}: no frame can be used: {reason}"
            raise FrameSourceError(msg)

    def _is_camera_info(self, stored: StoredMessage) -> bool:
        """Whether others will be able to read it, as they get the bytes that are there."""
        try:
            stored.decode()
        except FrameError as error:
            where = f"{self._path}: {stored.topic} at {stored.time_ns} ns"
            problem = self._health.problem or f"{where}: {error}"
            self._health = replace(self._health, problem=problem)
            return False
        return True

    def _used_bits(self) -> int:
        depth = BitDepth(say=str)
        messages = [item for item in self._timeline.messages if item.topic == self.image_topic]
        for stored in self._storage.read(messages):
            with suppress(FrameError):
                image_from_msg(stored.decode(), None, depth)
        return depth.bits

    def _read_frame(self, stored: StoredMessage) -> RecordedFrame:
        times = stored.time_s, stored.moment_ns
        message = stored.decode()
        stamp = message.header.stamp
        stamp_ns = stamp.sec * NS_PER_S + stamp.nanosec
        if stamp_ns < 0:
            msg = f"header.stamp: found {stamp.sec} s, expected 0 or more"
            raise FrameError(msg)
        frame_id = message.header.frame_id
        if self._shape is not None and self.of_surfaces:
            surface = surface_from_msg(message, self._shape)
            return RecordedFrame(*times, stamp_ns, frame_id, surface)
        if not hasattr(message, "format"):
            # Before it is converted: a wrong one may be large.
            self._check_size((message.width, message.height))
        image = image_from_msg(message, None, self._depth)
        size = (image.shape[1], image.shape[0])
        self._check_size(size)
        self._expected_size = size
        return RecordedFrame(*times, stamp_ns, frame_id, image, self.has_camera_info)

    def _check_size(self, size: ImageSize) -> None:
        if self._expected_size not in (None, size):
            self._wrong_sizes += 1
            msg = f"found {size_text(size)}, expected {size_text(self._expected_size)}"
            raise FrameError(msg)


def _topics_with_frames(storage: BagStorage, wanted: str) -> dict[str, str]:
    """Kinds by topic, without image topics that are empty, or poorer than their other transport.

    A recorder of all topics may get nothing, or the first frames alone, of one of two transports.
    wanted: stays if it has frames.
    """
    images = image_topics(storage.topics)
    if len(images) < 2:
        return storage.topics
    counts = Counter(message.topic for message in storage.index(images))
    bases = {name.removesuffix(COMPRESSED) for name in images}
    best = {max((base, base + COMPRESSED), key=lambda name: counts[name]) for base in bases}
    kept = {name for name in (*best, wanted) if counts[name]} or best
    return {
        name: kind for name, kind in storage.topics.items() if name in kept or name not in images
    }


def image_topics(topics: Mapping[str, str]) -> list[str]:
    """The topics of images, in order."""
    return sorted(name for name, kind in topics.items() if kind in (IMAGE, COMPRESSED_IMAGE))


def of_one_sensor(topics: dict[str, str], namespace: str) -> dict[str, str]:
    """The topics below a sensor's namespace, or all where none is."""
    own = {name: kind for name, kind in topics.items() if name.startswith(f"/{namespace}/")}
    return own or topics


def _choose_topic(path: Path, topics: dict[str, str], wanted: str, *, surfaces: bool) -> str:
    images = image_topics(topics)
    if surfaces and (topics.get(wanted) == SURFACE or not images):
        return _surface_topic(path, topics, wanted)
    found = _listed(topics) or "none"
    if wanted:
        base = wanted.removesuffix(COMPRESSED)
        if found_on := [name for name in (wanted, base, base + COMPRESSED) if name in images]:
            return found_on[0]
        msg = f"{path}: found no images on {wanted!r}; topics: {found}"
        raise FrameSourceError(msg)
    if not images:
        msg = f"{path}: found no topic of type {IMAGE} or {COMPRESSED_IMAGE}; topics: {found}"
        raise FrameSourceError(msg)
    if len(images) == 1:
        return images[0]
    bases = {name: name.removesuffix(COMPRESSED) for name in images}
    camera = [name for name in images if bases[name].endswith("image_raw")]
    # A recording of a running sensor holds its views and overlays too; the camera's is outermost.
    least = min((bases[name].count("/") for name in camera), default=0)
    outermost = [name for name in camera if bases[name].count("/") == least]
    if len({bases[name] for name in outermost}) == 1:
        return outermost[0]
    msg = f"{path}: found several image topics, expected the name of one of: {', '.join(images)}"
    raise FrameSourceError(msg)


def _surface_topic(path: Path, topics: dict[str, str], wanted: str) -> str:
    """The topic named, or the only one: a latched `reference` beside it is none of frames."""
    named = sorted(name for name, kind in topics.items() if kind == SURFACE)
    names = [name for name in named if not name.endswith("/reference")] or named
    if wanted in named or (len(names) == 1 and not wanted):
        return wanted or names[0]
    found = f"the topics {_listed(topics)}" if topics else "no topics"
    one = f"one of: {', '.join(names)}" if names else f"images or {SURFACE}"
    msg = f"{path}: found {found}; expected {wanted or one}"
    raise FrameSourceError(msg)


def _listed(topics: dict[str, str]) -> str:
    return ", ".join(f"{name} ({kind})" for name, kind in sorted(topics.items()))


def _info_topic(topics: dict[str, str], image_topic: str) -> str | None:
    """The camera info in the same namespace as the images (`a/image_raw` -> `a/camera_info`)."""
    namespace = image_topic.removesuffix(COMPRESSED).rpartition("/")[0]
    name = f"{namespace}/camera_info"
    return name if topics.get(name) == CAMERA_INFO else None


def calibration_mismatch(origin: str, found: ViewCameraInfo, sensor: SensorDescription) -> str:
    """The first difference in one line: origin, field, found, expected; empty where they agree.

    Size, lens model, K and D are compared: sizes that are set, which are not 0; the others only
    where the camera is calibrated, with K other than 0, and the sensor has one camera for the whole
    frame.  Models of a pinhole differ by their coefficients alone.
    """
    for field, value, expected in _differences(found, sensor):
        hint = f"is {sensor.name} the description of this sensor?"
        return f"{origin}: {field}: found {value}, expected {expected}: {hint}"
    return ""


def _differences(
    found: ViewCameraInfo, sensor: SensorDescription
) -> Iterator[tuple[str, object, object]]:
    """Field, value found and value expected."""
    for field in ("width", "height"):
        size, expected_size = getattr(found, field), getattr(sensor.image, field)
        if size not in (0, expected_size):
            yield field, size, expected_size
    camera = sensor.camera
    if camera is None or not found.K.any():
        return
    model, K = ROS_MODEL[camera.model], whole_frame_info(sensor).K
    if found.model != model and ROS_MODEL["equidistant"] in (found.model, model):
        yield "distortion_model", found.model or "nothing", model
    if not np.allclose(found.K, K, rtol=0, atol=MATRIX_TOLERANCE_PX):
        yield "K", _numbers(found.K), _numbers(K)
    expected = np.array(camera.distortion)
    length = max(found.D.size, expected.size)
    # Coefficients that are left out are 0.
    D, D_expected = (np.pad(D, (0, length - D.size)) for D in (found.D, expected))
    if not np.allclose(D, D_expected, rtol=0, atol=DISTORTION_TOLERANCE):
        yield "D", _numbers(found.D), _numbers(expected)


def _numbers(values: NDArray[np.float64]) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values.ravel()) + "]"
