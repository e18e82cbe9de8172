"""Collects what a sensor's nodes publish, as any other process on the network would see it."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock

from cmp_tactile_msgs.msg import ForceField, Grid, Surface

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


class Collector:
    """Subscribes to RESULTS of one sensor and to CLOCK, on a thread of its own; a context manager.

    Not to the images: 0.8 MB each overrun the middleware's buffers between processes, and the
    repair delays whatever is sent beside them by half a second.  The replay publishes CLOCK right
    before each image, which tells when that was.

    Messages stay as the bytes that came until they are asked for, so that collecting takes little
    from those who compute.
    """

    def __init__(self, namespace: str) -> None:
        self._namespace = namespace
        self._context = Context()
        self._bytes: dict[str, list[tuple[bytes, int, int]]] = {name: [] for name in TOPICS}

    def __enter__(self) -> Collector:
        # The process's own signals end it; rclpy's handlers would end the context first.
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node("collector", namespace=self._namespace, context=self._context)
        qos = QoSProfile(depth=QUEUE_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        self._subscriptions = [
            self.node.create_subscription(kind, name, self._listener(name), qos, raw=True)
            for name, kind in TOPICS.items()
        ]
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, name="collector", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._executor.shutdown()
        self._thread.join()
        self.node.destroy_node()
        self._context.try_shutdown()

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

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            return
