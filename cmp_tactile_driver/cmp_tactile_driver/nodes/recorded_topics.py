"""Topics that are to be recorded, once somebody publishes them, and their messages for the bag."""

from __future__ import annotations

import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import cv2
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from sensor_msgs.msg import CompressedImage, Image

from cmp_tactile_driver.bags.recorder import EncodedMessage
from cmp_tactile_driver.errors import BagWriteError
from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.ros.messages.conversions import message_class
from cmp_tactile_processing.ros.messages.reading import image_from_msg, stamp_ns

__all__ = [
    "FoundTopic",
    "TopicWatch",
    "frame_encoder",
    "message_encoder",
    "message_type",
]

SUBSCRIPTION_DEPTH = 100


@dataclass(frozen=True)
class FoundTopic:
    """A topic that is published.  kind: its type's name.

    qos: for a subscription that all publishers match.  offered: profiles of the publishers.
    """

    name: str
    kind: str
    qos: QoSProfile
    offered: tuple[Qos, ...]


class TopicWatch:
    """The topics that fit a list of names and patterns."""

    def __init__(self, node: Node, wanted: Sequence[str]) -> None:
        """wanted: relative to the node's namespace or absolute; `*` stands for anything."""
        self._node = node
        self._wanted = [
            _below(node.get_namespace(), item) if "*" in item else node.resolve_topic_name(item)
            for item in wanted
        ]
        self._own = node.get_fully_qualified_name() + "/"
        self._found: dict[str, QoSProfile] = {}

    @property
    def missing(self) -> list[str]:
        """Names, without patterns, that nobody has published yet."""
        return [item for item in self._wanted if "*" not in item and item not in self._found]

    @property
    def complete(self) -> bool:
        """Whether there is nothing to wait for."""
        return not self.missing and not any("*" in item for item in self._wanted)

    def forget(self) -> None:
        """Find all of them again."""
        self._found.clear()

    def new_topics(self) -> list[FoundTopic]:
        """Those that were not found before, or have got a first publisher that is best effort.

        A reliable subscription gets nothing of that, one with the new `qos` hears all.
        """
        found = []
        for name, kinds in self._node.get_topic_names_and_types():
            if name.startswith(self._own):
                continue
            if not any(fnmatchcase(name, item) for item in self._wanted):
                continue
            publishers = self._node.get_publishers_info_by_topic(name)
            if not publishers:
                continue
            profiles = [item.qos_profile for item in publishers]
            known = self._found.get(name)
            qos = _matching_qos([*profiles, known] if known else profiles)
            if known is None or qos.reliability != known.reliability:
                self._found[name] = qos
                offered = tuple(_recorded_qos(item) for item in profiles)
                found.append(FoundTopic(name, kinds[0], qos, offered))
        return found


def message_type(kind: str) -> Any:
    """The class of "sensor_msgs/msg/Image"; BagWriteError where its package is not installed."""
    try:
        return message_class(kind)
    except (ImportError, AttributeError):
        msg = f"{kind}: found no such message here, expected its package to be installed"
        raise BagWriteError(msg) from None


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


def _recorded_qos(qos: QoSProfile) -> Qos:
    return Qos(
        history=QosHistory[qos.history.name],
        depth=qos.depth,
        reliability=QosReliability[qos.reliability.name],
        durability=QosDurability[qos.durability.name],
        deadline=_time(qos.deadline),
        lifespan=_time(qos.lifespan),
        liveliness=QosLiveliness[qos.liveliness.name],
        liveliness_lease_duration=_time(qos.liveliness_lease_duration),
        avoid_ros_namespace_conventions=qos.avoid_ros_namespace_conventions,
    )


def _time(duration: Any) -> QosTime:
    return QosTime(*divmod(duration.nanoseconds, 10**9))


COMPRESSED = "sensor_msgs/msg/CompressedImage"
IMAGE = "sensor_msgs/msg/Image"
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
        return EncodedMessage(topic, kind, serialize_message(message), _stamp_ns(message))

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
            msg = f"width, height: {message.width} x {message.height} px cannot be made a {codec}"
            raise FrameError(msg)
        target = "" if message.encoding == "mono8" else "bgr8"
        compressed = CompressedImage(
            header=message.header, format=f"{message.encoding}; {codec} compressed {target}"
        )
        compressed.data = array.array("B", content.tobytes())
        return EncodedMessage(
            f"{topic}/compressed", COMPRESSED, serialize_message(compressed), _stamp_ns(message)
        )

    return encode


def _stamp_ns(message: Any) -> int | None:
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return None if stamp is None else stamp_ns(stamp)
