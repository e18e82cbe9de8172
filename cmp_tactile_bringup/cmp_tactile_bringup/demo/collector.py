"""Collects what a sensor's nodes publish, as any other process on the network would see it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from geometry_msgs.msg import WrenchStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock

from cmp_tactile_msgs.msg import ForceField, Grid, Surface
from cmp_tactile_processing.ros.process import Listener

__all__ = ["CLOCK", "RESULTS", "Arrival", "Collector"]

RESULTS: Mapping[str, type] = {
    "left/grid": Grid,
    "right/grid": Grid,
    "surface": Surface,
    "force_field": ForceField,
    "wrench": WrenchStamped,
}
CLOCK = "/clock"
TOPICS: Mapping[str, type] = {CLOCK: Clock, **RESULTS}
QUEUE_DEPTH = 200


@dataclass(frozen=True)
class Arrival:
    """A message, when it was published and when it arrived: ns since the epoch, one clock."""

    message: Any
    published_ns: int
    arrived_ns: int


class Collector(Listener):
    """Subscribes to RESULTS of one sensor and to CLOCK, on a thread of its own; a context manager.

    Not to the images: 0.8 MB each overrun the middleware's buffers between processes, and the
    repair delays whatever is sent beside them by half a second.  The replay publishes CLOCK right
    before each image, which tells when that was.

    Messages stay as the bytes that came until they are asked for, so that collecting takes little
    from those who compute.
    """

    def __init__(self, namespace: str) -> None:
        super().__init__("collector", namespace)
        self._bytes: dict[str, list[tuple[bytes, int, int]]] = {name: [] for name in TOPICS}

    def _subscribe(self) -> None:
        qos = QoSProfile(depth=QUEUE_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        self._subscriptions = [
            self.node.create_subscription(kind, name, self._listener(name), qos, raw=True)
            for name, kind in TOPICS.items()
        ]

    def connected(self) -> bool:
        """Whether every topic has a publisher that knows of this subscriber's existence."""
        return all(item.get_publisher_count() > 0 for item in self._subscriptions)

    def count(self, topic: str) -> int:
        """How many messages have come on a topic."""
        return len(self._bytes[topic])

    def arrivals(self, topic: str) -> list[Arrival]:
        """The messages of a topic, in the order in which they came."""
        kind = TOPICS[topic]
        return [
            Arrival(deserialize_message(data, kind), published, arrived)
            for data, published, arrived in list(self._bytes[topic])
        ]

    def _listener(self, topic: str) -> Any:
        messages = self._bytes[topic]

        def on_message(data: bytes, info: Mapping[str, int]) -> None:
            messages.append((data, info["source_timestamp"], time.time_ns()))

        return on_message
