"""Node: records a sensor's topics into a bag, once somebody publishes them."""

from __future__ import annotations

import array
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any

import cv2
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.exceptions import NoTypeSupportImportedException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rclpy.type_support import check_for_type_support
from rosbags import interfaces
from sensor_msgs.msg import CompressedImage, Image
from std_srvs.srv import SetBool

from cmp_tactile_driver.bags.reader import COMPRESSED_IMAGE, IMAGE
from cmp_tactile_driver.bags.writer import (
    BagRecorder,
    BagWriter,
    EncodedMessage,
    RecorderState,
    RecordingProgress,
    Tap,
    put_sensor_beside,
)
from cmp_tactile_driver.sources.parameters import MEGABYTE, RecorderParameters
from cmp_tactile_processing.cache.files import expanded_path
from cmp_tactile_processing.errors import FrameError, FrameSourceError, OutputError
from cmp_tactile_processing.image.encodings import COMPRESSED
from cmp_tactile_processing.measured import NS_PER_S
from cmp_tactile_processing.ros.base_nodes import ReportingNode, latched_qos
from cmp_tactile_processing.ros.diagnostics import InputWatch, SentFrames
from cmp_tactile_processing.ros.messages.conversions import image_from_topic, message_class
from cmp_tactile_processing.ros.parameters import declare_parameters
from cmp_tactile_processing.ros.process import run_node
from cmp_tactile_processing.ros.wiring import Input, LazyResult
from cmp_tactile_processing.sensor.description import load_sensor

SUBSCRIPTION_DEPTH = 100
# Publishers of one image in two transports come one after the other.
TRANSPORT_PATIENCE_S = 1.0
SEARCH_PERIOD_S = 0.2
EARLY_LIMIT = 1000
ENCODED = ("mono8", "bgr8", "rgb8")
# Camera noise leaves PNG's dictionary nothing to find, and of its filters only the fixed ones are
# quick: 8 ms a frame of 1024 x 768 px instead of 15 to 150, at 5 % more bytes than the best.
PNG_OPTIONS = (
    cv2.IMWRITE_PNG_COMPRESSION,
    1,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_AVG,
)


@dataclass(frozen=True)
class FoundTopic:
    """A topic that is published.  kind: its type's name.

    qos: for a subscription that all publishers match.  offered: profiles of the publishers.
    instead_of: the wanted topic whose image this has, where nobody publishes that.
    """

    name: str
    kind: str
    qos: QoSProfile
    offered: tuple[interfaces.Qos, ...]
    instead_of: str = ""


class TopicWatch:
    """The topics that fit a list of names and patterns.

    Of an image that comes as TOPIC/compressed alone, that is taken for TOPIC.
    """

    def __init__(self, node: Node, wanted: Sequence[str]) -> None:
        """wanted: relative to the node's namespace or absolute; `*` stands for anything."""
        self._node = node
        self._wanted = [
            _below(node.get_namespace(), item) if "*" in item else node.resolve_topic_name(item)
            for item in wanted
        ]
        self._own = node.get_fully_qualified_name() + "/"
        self._found: set[str] = set()
        self._compressed_since: dict[str, float] = {}

    @property
    def missing(self) -> list[str]:
        """Names, without patterns, that nobody has published yet."""
        names = [item for item in self._wanted if "*" not in item]
        return [item for item in names if not self._found & {item, item + COMPRESSED}]

    @property
    def is_over(self) -> bool:
        """Whether all are found, and none by a pattern may come."""
        return not self.missing and not any("*" in item for item in self._wanted)

    def forget(self) -> None:
        """Find all of them again."""
        self._found.clear()

    def new_topics(self) -> list[FoundTopic]:
        """Those that somebody publishes, and that were not found before."""
        kinds_of = dict(self._node.get_topic_names_and_types())
        in_place = self._compressed_alone(kinds_of)
        found = []
        for name, kinds in kinds_of.items():
            is_wanted = any(fnmatchcase(name, item) for item in (*self._wanted, *in_place))
            if not is_wanted or name in self._found or name.startswith(self._own):
                continue
            publishers = self._node.get_publishers_info_by_topic(name)
            if publishers:
                self._found.add(name)
                offered = [item.qos_profile for item in publishers]
                qos, profiles = _matching_qos(offered), tuple(map(_recorded_qos, offered))
                found.append(FoundTopic(name, kinds[0], qos, profiles, in_place.get(name, "")))
        return found

    def _compressed_alone(self, kinds_of: dict[str, list[str]]) -> dict[str, str]:
        """Topics of compressed images, with the wanted one that is not there for a while."""
        now, since = time.monotonic(), self._compressed_since
        alone = [
            item
            for item in self.missing
            if kinds_of.get(item + COMPRESSED) == [COMPRESSED_IMAGE]
            and self._node.count_publishers(item + COMPRESSED)
            and not self._node.count_publishers(item)
        ]
        self._compressed_since = {item: since.get(item, now) for item in alone}
        return {
            item + COMPRESSED: item
            for item, first in self._compressed_since.items()
            if now - first >= TRANSPORT_PATIENCE_S
        }


def _below(namespace: str, name: str) -> str:
    return name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"


def _matching_qos(offered: Sequence[QoSProfile]) -> QoSProfile:
    """Reliable and latched where every publisher is so: less is what all of them match."""
    reliable = all(item.reliability == ReliabilityPolicy.RELIABLE for item in offered)
    latched = all(item.durability == DurabilityPolicy.TRANSIENT_LOCAL for item in offered)
    return QoSProfile(
        depth=SUBSCRIPTION_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def _recorded_qos(qos: QoSProfile) -> interfaces.Qos:
    return interfaces.Qos(
        history=interfaces.QosHistory[qos.history.name],
        depth=qos.depth,
        reliability=interfaces.QosReliability[qos.reliability.name],
        durability=interfaces.QosDurability[qos.durability.name],
        deadline=_time(qos.deadline),
        lifespan=_time(qos.lifespan),
        liveliness=interfaces.QosLiveliness[qos.liveliness.name],
        liveliness_lease_duration=_time(qos.liveliness_lease_duration),
        avoid_ros_namespace_conventions=qos.avoid_ros_namespace_conventions,
    )


def _time(duration: Any) -> interfaces.QosTime:
    return interfaces.QosTime(*divmod(duration.nanoseconds, NS_PER_S))


def message_encoder(topic: str, kind: str) -> Callable[[Any], EncodedMessage]:
    """Encodes messages of a topic as they are."""

    def encode(message: Any) -> EncodedMessage:
        return EncodedMessage(topic, kind, serialize_message(message))

    return encode


def frame_encoder(topic: str, codec: str, quality: int) -> Callable[[Image], EncodedMessage]:
    """Encodes Images as CompressedImages on TOPIC/compressed.  codec: "png" or "jpeg".

    Frames in other encodings than mono8, bgr8 and rgb8 stay as they are, on their own topic.
    """
    options = PNG_OPTIONS if codec == "png" else (cv2.IMWRITE_JPEG_QUALITY, quality)
    suffix = ".png" if codec == "png" else ".jpg"
    as_it_is = message_encoder(topic, IMAGE)

    def encode(message: Image) -> EncodedMessage:
        if message.encoding not in ENCODED:
            return as_it_is(message)
        done, content = cv2.imencode(suffix, image_from_topic(message), options)
        if not done:
            msg = (
                f"width, height: found {message.width} x {message.height} px, expected a size that "
                f"{codec} supports"
            )
            raise FrameError(msg)
        target = "" if message.encoding == "mono8" else "bgr8"
        compressed = CompressedImage(
            header=message.header, format=f"{message.encoding}; {codec} compressed {target}"
        )
        compressed.data = array.array("B", content.tobytes())
        return EncodedMessage(topic + COMPRESSED, COMPRESSED_IMAGE, serialize_message(compressed))

    return encode


class Recorder(ReportingNode):
    """Records topics into a bag that `replay`, `ros2 bag` and other readers of MCAP take.

    Each message is stored with the time of its arrival.
    `compression` applies to frames.  With png and jpeg they are stored as `image_raw/compressed`;
    if only that topic is published, it is recorded in place of `image_raw`.  A topic is recorded
    reliably if its publishers are reliable when it is found.  The sensor description is stored
    as `sensor.yaml` in the same folder.  If the disk is too slow, messages are dropped and counted.
    If the bag cannot be written, the recording ends; what was written is kept and the diagnostics
    say why.
    `~/record` starts and stops: a second recording takes the folder with _2 after its name, or
    where no folder is given, one with the time in its name.
    `~/status` (latched) reports state and counts.
    Raises CmpTactileError if the parameters or the folder cannot be used.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("recorder", **node_kwargs)
        self._recorder: BagRecorder | None = None
        self._taken = SentFrames()
        with self.destroyed_on_error():
            self._set_up()

    @property
    def progress(self) -> RecordingProgress | None:
        """Of the recording, also when it is over; None before the first.  From any thread."""
        return self._recorder.progress if self._recorder is not None else None

    @property
    def missing_topics(self) -> list[str]:
        """Topics that are to be recorded and that nobody has published yet."""
        return self._watch.missing

    def destroy_node(self) -> None:
        """Close the bag, then destroy the node."""
        if self._recorder is not None:
            self._recorder.stop()
        super().destroy_node()

    def _set_up(self) -> None:
        self._settings = declare_parameters(self, RecorderParameters())
        self._sensor = load_sensor(self._settings.sensor_description, self._settings.sensor_name)
        topics = self._settings.topics.replace(",", " ").split()
        if not topics:
            msg = f"{self.get_name()}: parameter topics: found none, expected at least one"
            raise OutputError(msg)
        self._watch = TopicWatch(self, topics)
        # Of the recording.
        self.bag: Path | None = None
        self._taps: list[tuple[Tap, InputWatch]] = []
        self._lost: Counter[str] = Counter()
        self._early: list[tuple[Tap, Any]] = []
        self._reported: RecorderState | None = None
        self._status_publisher = self.create_publisher(DiagnosticStatus, "~/status", latched_qos())
        self.create_service(SetBool, "~/record", self._on_record)
        if self._settings.autostart:
            self._start()
        self.create_steady_timer(SEARCH_PERIOD_S, self._look_for_topics)
        self.start_reporting(also_to=[self._status_publisher])
        self.warn_of_unknown_parameters()
        self.report()

    def _is_recording(self) -> bool:
        progress = self.progress
        return progress is not None and progress.state is RecorderState.RECORDING

    def _start(self) -> None:
        """Begin a recording; CmpTactileError where its folder cannot be made."""
        settings = self._settings
        folder = self._next_folder()
        writer = BagWriter(folder, compressed=settings.compression == "zstd")
        try:
            put_sensor_beside(folder, settings.sensor_description, settings.sensor_name)
        except OutputError:
            writer.close()
            raise
        self.bag = folder
        self._recorder = BagRecorder(writer, round(settings.queue_size * MEGABYTE))
        self._watch.forget()
        self._look_for_topics()
        self.get_logger().info(f"recording to {folder}")

    def stop(self) -> None:
        """End the recording: what waits is written, and the bag is closed."""
        self._count_losses()
        for _, watch in self._taps:
            self.disconnect_input(watch.end)
        self._taps.clear()
        self._lost.clear()
        self._early.clear()
        if self._recorder is not None:
            self._recorder.stop()

    def _next_folder(self) -> Path:
        output = self._settings.output
        if not output:
            when = datetime.now().strftime("%Y_%m_%d-%H_%M_%S")  # noqa: DTZ005  as rosbag2 does
            # Whoever calls the service may be in another folder.
            output = str(Path.cwd() / f"{self._sensor.ros_name}_{when}")
        first = expanded_path(output)
        if self.bag is None or not (self._settings.output or first.exists()):
            return first
        number = 2
        while (folder := first.with_name(f"{first.name}_{number}")).exists():
            number += 1
        return folder

    def _look_for_topics(self) -> None:
        if self._is_recording() and not self._watch.is_over:
            for topic in self._watch.new_topics():
                self._subscribe(topic)

    def _subscribe(self, topic: FoundTopic) -> None:
        try:
            kind = message_class(topic.kind)
            check_for_type_support(kind)
        except (ImportError, AttributeError, NoTypeSupportImportedException):
            text = "found no such message type, expected its package to be built for this Python"
            self.get_logger().warning(f"{topic.name}: not recorded: {topic.kind}: {text}")
            return
        if topic.instead_of:
            text = f"not published; {topic.name} is recorded instead"
            self.get_logger().warning(f"{topic.instead_of}: {text}")
        tap = self._tap(topic)
        end = Input(lambda given: partial(self._on_message, tap, watch, given))
        watch = InputWatch(end)
        self.connect_input(end, kind, tap.topic, topic.qos)
        self._taps.append((tap, watch))

    def _tap(self, topic: FoundTopic) -> Tap:
        codec = self._settings.compression
        if topic.kind == IMAGE and codec in ("png", "jpeg"):
            encode = frame_encoder(topic.name, codec, self._settings.jpeg_quality)
        else:
            encode = message_encoder(topic.name, topic.kind)
        return Tap(topic.name, encode, topic.offered)

    def _count_losses(self) -> None:
        for tap, watch in self._taps:
            new = watch.lost - self._lost[tap.topic]
            if new and self._recorder is not None:
                self._lost[tap.topic] += new
                self._recorder.lost(tap, new)

    def _on_message(self, tap: Tap, watch: InputWatch, given: LazyResult) -> None:
        message = given.message
        watch.take(given.info)
        recorder, now_ns = self._recorder, self.get_clock().now().nanoseconds
        if recorder is None:
            return
        self._taken.sent()
        if not now_ns:
            # Simulated time has not begun: what is latched came before its first tick.
            if len(self._early) < EARLY_LIMIT:
                self._early.append((tap, message))
            return
        for early_tap, early_message in self._early:
            recorder.put(early_tap, now_ns, early_message)
        self._early.clear()
        recorder.put(tap, now_ns, message)

    def _on_record(self, request: Any, response: Any) -> Any:
        response.success = True
        try:
            if request.data and not self._is_recording():
                self.stop()
                self._start()
            elif not request.data:
                self.stop()
        except (FrameSourceError, OutputError) as error:
            response.success = False
            response.message = str(error)
            return response
        response.message = f"{self._state_text()}: {self.bag}"
        self.report()
        return response

    def _state_text(self) -> str:
        progress = self.progress
        return progress.state.value if progress is not None else "idle"

    def _status(self) -> DiagnosticStatus:
        self._count_losses()
        progress = self.progress
        self._report_change(progress)
        records = self._is_recording()
        values: dict[str, object] = {"state": self._state_text()}
        findings = []
        if progress is not None:
            missing = self.missing_topics if records else []
            values |= _figures(progress)
            values |= {"bag": self.bag, "not published yet": " ".join(missing)}
            findings = [progress.finding]
        values["rate (Hz)"] = self._taken.close_period()["rate (Hz)"]
        return self.status_of(self._sensor.ros_name, values, findings, self._state_text())

    def _report_change(self, progress: RecordingProgress | None) -> None:
        state = progress.state if progress is not None else None
        if progress is not None and state is not self._reported:
            if state is RecorderState.FAILED:
                self.get_logger().error(f"recording ended: {progress.problem}")
            elif state is RecorderState.FINISHED:
                self.get_logger().info(f"recorded {sum(progress.messages.values())} messages")
        self._reported = state


def _figures(progress: RecordingProgress) -> dict[str, object]:
    return {
        "messages": sum(progress.messages.values()),
        "dropped": sum(progress.dropped.values()),
        "size (MB)": f"{progress.size / MEGABYTE:.1f}",
        "duration (s)": f"{progress.duration_s:.1f}",
        "queue (MB)": f"{progress.queued_bytes / MEGABYTE:.1f}",
        **{f"messages {topic}": count for topic, count in progress.messages.items()},
        **{f"dropped {topic}": count for topic, count in progress.dropped.items()},
        "problem": progress.problem,
    }


def main() -> int:
    """Run the node as a process."""
    return run_node(Recorder)


if __name__ == "__main__":
    sys.exit(main())
