"""Simulated time for all nodes of a process: one subscription to /clock, on a thread of its own.

By itself every node subscribes, and for each message its executor builds its wait set again: with
1000 messages a second, seven nodes take a whole processor (ros2/rclpy 1378, ros/ros_comm 2342).
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.context import Context
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

# How often the topic is looked at, s.  An executor would cost as much as that of a node.
PERIOD_S = 0.005
WARNING_PERIOD_S = 5.0


@dataclass(eq=False)
class ClockListener:
    """Stands for a subscription of a node.  take: its callback, on the thread of the clock."""

    topic: str
    take: Callable[[Clock], None]
    clock: SharedClock

    def close(self) -> None:
        """Listen no more.  When this returns, no callback is running."""
        self.clock.forget(self)


class SharedClock:
    """Hears topics of time once for all listeners; all methods may be called from any thread."""

    def __init__(self, context: Context) -> None:
        self._context = context
        # Held while the topics are subscribed to; never while a listener takes a message, as rclpy
        # has a lock of its own for new nodes.
        self._making = threading.Lock()
        self._node: Node | None = None
        self._subscriptions: dict[str, Any] = {}
        # Held while listeners take a message.
        self._lock = threading.Lock()
        self._listeners: list[ClockListener] = []
        self._last: dict[str, Clock] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="clock", daemon=True)

    def listen(self, topic: str, take: Callable[[Clock], None]) -> ClockListener:
        """Hear a topic from now on; its last message, if any, is passed on at once."""
        with self._making:
            if topic not in self._subscriptions and not self._ended.is_set():
                self._subscribe(topic)
        listener = ClockListener(topic, take, self)
        with self._lock:
            self._listeners.append(listener)
            if topic in self._last:
                self._give([listener], self._last[topic])
        return listener

    def forget(self, listener: ClockListener) -> None:
        """Give a listener no more."""
        with self._lock:
            if listener in self._listeners:
                self._listeners.remove(listener)

    def close(self) -> None:
        """Hear nothing any more."""
        self._ended.set()
        with self._making:
            node, self._node = self._node, None
        if node is not None:
            self._thread.join()
            node.destroy_node()

    def _subscribe(self, topic: str) -> None:
        node = self._node
        if node is None:
            # Hidden from `ros2 node list`.
            node = Node(
                f"_clock_{os.getpid()}",
                context=self._context,
                use_global_arguments=False,
                enable_rosout=False,
                start_parameter_services=False,
            )
            self._thread.start()
            self._node = node
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._subscriptions[topic] = node.create_subscription(Clock, topic, lambda _: None, newest)

    def _run(self) -> None:
        while not self._ended.wait(PERIOD_S) and self._context.ok():
            for topic, subscription in list(self._subscriptions.items()):
                try:
                    with subscription.handle:
                        taken = subscription.handle.take_message(Clock, False)
                except Exception as error:  # noqa: BLE001  the next one may be better
                    self._report(error)
                    continue
                if taken is not None:
                    with self._lock:
                        self._last[topic] = taken[0]
                        heard = [item for item in self._listeners if item.topic == topic]
                        self._give(heard, taken[0])

    def _give(self, listeners: list[ClockListener], now: Clock) -> None:
        for listener in listeners:
            try:
                listener.take(now)
            except Exception as error:  # noqa: BLE001, PERF203  the others hear it, too
                self._report(error)

    def _report(self, error: Exception) -> None:
        # A signal shuts the context down first; what then fails in rcl is part of the end.
        if self._context.ok():
            text = f"simulated time: {type(error).__name__}: {error}"
            get_logger("clock").error(text, throttle_duration_sec=WARNING_PERIOD_S)
