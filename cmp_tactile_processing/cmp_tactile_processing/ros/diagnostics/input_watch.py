"""What arrives on one topic: what was lost on the way, what waits, and stamps out of order."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from cmp_tactile_processing.ros.diagnostics.stamp_watch import Stamp, StampWatch
from cmp_tactile_processing.ros.intra_process import Inbox
from cmp_tactile_processing.ros.intra_process_node import inbox_of

__all__ = ["InputWatch"]

NS_PER_S = 1e9
# Publishers whose numbers are remembered; more come and go over a long run.
MOST_PUBLISHERS = 16


class InputWatch:
    """Counts for one subscription; `take` once per message, in the order of the callbacks.

    lost: messages that the publisher sent and this subscription never got.
    subscription: where its messages are handed over in process, its inbox tells queue and losses.
    """

    def __init__(self, topic: str, depth: int) -> None:
        self.topic = topic
        self.depth = depth
        self.subscription: Any = None
        self.received = 0
        self._stamps = StampWatch()
        self._lost = 0
        self._numbers: dict[bytes, int] = {}
        self._in_order = True
        self._waited_ns = 0

    @property
    def stamps(self) -> Mapping[Stamp, int]:
        """How often each kind of stamp came."""
        return self._stamps.stamps

    @property
    def missing(self) -> int:
        """Further frames that gaps between stamps speak of."""
        return self._stamps.missing

    @property
    def lost(self) -> int:
        """Messages lost on the way or pushed out of the queue, since the start."""
        inbox = self._inbox
        return self._lost + (0 if inbox is None else inbox.dropped)

    def tell_lost(self, count: int) -> None:
        """Messages were lost, as the middleware says."""
        self._lost += count

    def take(self, stamp_ns: int, info: Mapping[str, Any] | None) -> Stamp:
        """Take a message into account; stamp_ns: of its header; info: rclpy's of the message."""
        self.received += 1
        if info is not None:
            self._number(info)
            received_ns = info["received_timestamp"]
            if received_ns:
                self._waited_ns = max(self._waited_ns, time.time_ns() - received_ns)
        return self._stamps.take(stamp_ns, self.lost)

    def waiting(self, rate: float) -> float:
        """How many messages waited at most since the last call; rate: at which they come, Hz.

        From the time that a message waited, unless the subscription tells its queue.
        """
        waited_s, self._waited_ns = self._waited_ns / NS_PER_S, 0
        inbox = self._inbox
        queued = 0 if inbox is None else inbox.queued
        return max(float(queued), min(waited_s * rate, float(self.depth)))

    @property
    def _inbox(self) -> Inbox | None:
        return None if self.subscription is None else inbox_of(self.subscription)

    def _number(self, info: Mapping[str, Any]) -> None:
        number = info.get("publication_sequence_number")
        if number is None:
            return
        publisher = info.get("publisher_gid", {})
        if publisher is None:
            return  # It was handed over: the inbox knows.
        # ROS 2 Jazzy does not tell the publisher.
        key = publisher.get("data", b"")
        last = self._numbers.get(key)
        if last is None and len(self._numbers) == MOST_PUBLISHERS:
            self._numbers.clear()
        elif last is not None:
            # Numbers of two unknown publishers go up and down by turns.
            if number > last + 1 and self._in_order:
                self._lost += number - last - 1
            self._in_order = number > last and (self._in_order or number == last + 1)
        self._numbers[key] = number
