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
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

# How often it is looked for a new time, s: no executor, which would take as much as a node's.
PERIOD_S = 0.005


@dataclass(eq=False)
class ClockListener:
    """Stands for a subscription of a node.  take: its callback, on the thread of the clock."""

    take: Callable[[Clock], None]
    clock: SharedClock
    topic: str

    def close(self) -> None:
        """Take no more; a callback that runs has ended."""
        self.clock.forget(self)


class SharedClock:
    """Hears topics of time once for all listeners; all methods may be called from any thread."""

    def __init__(self, context: Context) -> None:
        self._context = context
        # Held while listeners take a message.
        self._lock = threading.RLock()
        self._listeners: dict[str, list[ClockListener]] = {}
        self._last: dict[str, Clock] = {}
        self._subscriptions: dict[str, Any] = {}
        self._node: Node | None = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="clock", daemon=True)

    def listen(self, topic: str, take: Callable[[Clock], None]) -> ClockListener:
        """Hear a topic from now on; what it had last comes at once."""
        listener = ClockListener(take, self, topic)
        with self._lock:
            if topic not in self._listeners:
                self._subscribe(topic)
            self._listeners[topic].append(listener)
            if topic in self._last:
                take(self._last[topic])
        return listener

    def forget(self, listener: ClockListener) -> None:
        """Give a listener no more."""
        with self._lock:
            if listener in self._listeners[listener.topic]:
                self._listeners[listener.topic].remove(listener)

    def close(self) -> None:
        """Hear nothing any more."""
        self._ended.set()
        if self._node is not None:
            self._thread.join()
            self._node.destroy_node()
            self._node = None

    def _subscribe(self, topic: str) -> None:
        if self._node is None:
            # Hidden from `ros2 node list`.
            self._node = Node(
                f"_clock_{os.getpid()}",
                context=self._context,
                use_global_arguments=False,
                enable_rosout=False,
                start_parameter_services=False,
            )
            self._thread.start()
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        subscription = self._node.create_subscription(Clock, topic, lambda _: None, newest)
        self._listeners[topic], self._subscriptions[topic] = [], subscription

    def _run(self) -> None:
        while not self._ended.wait(PERIOD_S) and self._context.ok():
            with self._lock:
                for topic, subscription in self._subscriptions.items():
                    with subscription.handle:
                        taken = subscription.handle.take_message(Clock, False)
                    if taken is not None:
                        self._last[topic] = taken[0]
                        for listener in self._listeners[topic]:
                            listener.take(taken[0])
