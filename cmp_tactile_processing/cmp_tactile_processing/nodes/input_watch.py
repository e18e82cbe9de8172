"""What arrives on one topic: what was lost on the way, what waits, and stamps out of order."""

from __future__ import annotations

import time
from collections.abc import Mapping
from enum import Enum
from typing import Any

from cmp_tactile_processing.nodes.hand_over import Inbox
from cmp_tactile_processing.nodes.hand_over_node import inbox_of

__all__ = ["InputWatch", "Stamp"]

NS_PER_S = 1e9
# An interval is a gap where it exceeds the usual one by this factor.
GAP_FACTOR = 1.6
# Gaps in a row after which they are the usual interval.
NEW_PACE = 5
SMOOTHING = 0.1
# Publishers whose numbers are remembered; more come and go over a long run.
MOST_PUBLISHERS = 16


class Stamp(Enum):
    """What a message's stamp is to that of the message before."""

    LATER = "later"
    BACK = "back"
    REPEATED = "repeated"
    ZERO = "zero"


class InputWatch:
    """Counts for one subscription; `take` once per message, in the order of the callbacks.

    stamps: how often each kind of stamp came; lost: messages that the publisher sent and this
    subscription never got; missing: further frames that gaps between stamps speak of.
    subscription: where its messages are handed over in process, its inbox tells queue and losses.
    """

    def __init__(self, topic: str, depth: int) -> None:
        self.topic = topic
        self.depth = depth
        self.subscription: Any = None
        self.received = 0
        self.missing = 0
        self.stamps = dict.fromkeys(Stamp, 0)
        self._lost = 0
        self._lost_before = 0
        self._stamp_ns = 0
        self._interval_ns = 0.0
        self._gaps = 0
        self._numbers: dict[bytes, int] = {}
        self._in_order = True
        self._waited_ns = 0

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
        kind = self._kind(stamp_ns)
        self.stamps[kind] += 1
        return kind

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

    def _kind(self, stamp_ns: int) -> Stamp:
        if stamp_ns == 0:
            return Stamp.ZERO
        passed, self._stamp_ns = stamp_ns - self._stamp_ns, stamp_ns
        if passed == 0:
            return Stamp.REPEATED
        if passed < 0:
            self._gaps = 0
            return Stamp.BACK
        if passed < stamp_ns:  # else it is the first
            lost = self.lost
            self._pace(passed, lost - self._lost_before)
            self._lost_before = lost
        return Stamp.LATER

    def _pace(self, passed_ns: int, lost: int) -> None:
        usual = self._interval_ns
        if usual and passed_ns > usual * GAP_FACTOR:
            self.missing += max(0, round(passed_ns / usual) - 1 - lost)
            if lost:
                return
            self._gaps += 1
            if self._gaps < NEW_PACE:
                return
            usual = 0.0
        self._gaps = 0
        self._interval_ns = usual + SMOOTHING * (passed_ns - usual) if usual else float(passed_ns)
