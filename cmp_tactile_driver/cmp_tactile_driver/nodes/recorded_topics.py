"""What is recorded: which topics, with which QoS, and the bytes of their messages."""

from __future__ import annotations

import array
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import cv2
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosbags import interfaces
from sensor_msgs.msg import CompressedImage, Image

from cmp_tactile_driver.bags.reader import COMPRESSED_IMAGE, IMAGE
from cmp_tactile_driver.bags.recorder import EncodedMessage
from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.image.encodings import COMPRESSED
from cmp_tactile_processing.ros.messages.reading import image_from_msg

SUBSCRIPTION_DEPTH = 100
# Publishers of one image in two transports come one after the other.
TRANSPORT_PATIENCE_S = 1.0


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
    return interfaces.QosTime(*divmod(duration.nanoseconds, 10**9))


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
        done, content = cv2.imencode(suffix, image_from_msg(message), options)
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
