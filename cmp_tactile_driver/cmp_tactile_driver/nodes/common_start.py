"""When a replay begins: once its subscribers are there, and together with other replays."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.node import Node
from rclpy.time import Time
from std_msgs.msg import Header

from cmp_tactile_driver.nodes.camera_messages import latched_qos

__all__ = ["SETTLE_TIME", "CommonStart"]

SETTLE_TIME = 0.2
"""From the last subscriber, or the last replay, to the beginning, s.

The subscriber's side of the match may still be under way, and all replays are to know of the last.
"""
NS_PER_S = 10**9


class CommonStart:
    """Each replay tells on its `~/ready` since when it is; all begin a moment after the last.

    The time is that of the system's clock, so that replays of one machine begin at once whatever
    the messages between them take.
    """

    def __init__(self, node: Node, is_ready: Callable[[], bool], others: str) -> None:
        """is_ready: whether the subscribers are there.  others: full names of the other replays."""
        self._is_ready = is_ready
        self._since_ns: dict[str, int | None] = {"": None}
        self._name = node.get_fully_qualified_name()
        self._publisher = node.create_publisher(Header, "~/ready", latched_qos())
        for other in others.split():
            name = f"/{'/'.join(part for part in other.split('/') if part)}"
            self._since_ns[name] = None
            node.create_subscription(Header, f"{name}/ready", self._keeper_for(name), latched_qos())

    def remaining(self) -> float | None:
        """Seconds until the beginning; None as long as somebody is not ready.  From any thread."""
        if self._since_ns[""] is None:
            if not self._is_ready():
                return None
            self._since_ns[""] = time.time_ns()
            stamp = Time(nanoseconds=self._since_ns[""]).to_msg()
            self._publisher.publish(Header(stamp=stamp, frame_id=self._name))
        known = [since for since in self._since_ns.values() if since is not None]
        if len(known) < len(self._since_ns):
            return None
        passed = (time.time_ns() - max(known)) / NS_PER_S
        # A clock of another machine may differ by anything.
        return min(max(0.0, SETTLE_TIME - passed), SETTLE_TIME)

    def _keeper_for(self, name: str) -> Callable[[Header], None]:
        def keep(message: Header) -> None:
            self._since_ns[name] = Time.from_msg(message.stamp).nanoseconds

        return keep
