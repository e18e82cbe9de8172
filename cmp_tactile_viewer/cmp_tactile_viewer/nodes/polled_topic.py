"""Topics of which the newest messages are looked at now and then."""

from __future__ import annotations

import math
import struct
import time
from collections import OrderedDict, deque
from collections.abc import Mapping
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile

# Encapsulation and stamp, with which every message begins.
HEADER = struct.Struct("<4xiI")
# Frames that may be on their way through the stages at once; an image is a megabyte.
KEPT = 12
NS_PER_S = 1_000_000_000
# The rate is that of so many frames.
RATE_FRAMES = 60


class Polled(CallbackGroup):
    """Of subscriptions that no executor waits for: to be woken costs more than the message."""

    def can_execute(self, _entity: object) -> bool:
        """Never."""
        return False

    def beginning_execution(self, _entity: object) -> bool:
        """Never."""
        return False

    def ending_execution(self, _entity: object) -> None:
        """Never begun."""


class PolledTopic:
    """The newest messages of a topic as bytes, by stamp: most are never looked at.

    name: as users know it.  field: what it gives.  kept: messages by stamp, ns, the newest last.
    last_s: when the newest came, by time.monotonic().  sent_ns: when it was sent, time.time_ns().
    """

    def __init__(self, name: str, message_type: Any, field: str) -> None:
        self.name, self.message_type, self.field = name, message_type, field
        self.kept: OrderedDict[int, bytes] = OrderedDict()
        self.stamps: deque[int] = deque(maxlen=RATE_FRAMES)
        self.last_s, self.sent_ns = time.monotonic(), 0
        self._subscription: Any = None

    def subscribe(self, node: Node, group: CallbackGroup) -> None:
        """Begin; again, nothing happens."""
        if self._subscription is not None:
            return
        self.kept.clear()
        self.stamps.clear()
        self.last_s = time.monotonic()
        self._subscription = node.create_subscription(
            self.message_type,
            self.name,
            lambda _: None,
            QoSProfile(depth=KEPT),
            callback_group=group,
            raw=True,
        )

    def unsubscribe(self, node: Node) -> None:
        """Until `subscribe`."""
        if self._subscription is not None:
            node.destroy_subscription(self._subscription)
            self._subscription = None

    def take(self) -> None:
        """All that came since."""
        if self._subscription is None:
            return
        handle = self._subscription.handle
        with handle:
            while (taken := handle.take_message(self.message_type, True)) is not None:
                self._keep(*taken)

    @property
    def newest(self) -> int:
        """Its last stamp; -1 before the first."""
        return next(reversed(self.kept), -1)

    @property
    def rate_hz(self) -> float:
        """Of the last messages; NaN where there is none yet."""
        span_ns = self.stamps[-1] - self.stamps[0] if self.stamps else 0
        return (len(self.stamps) - 1) * NS_PER_S / span_ns if span_ns > 0 else math.nan

    def _keep(self, data: bytes, info: Mapping[str, int]) -> None:
        seconds, nanoseconds = HEADER.unpack_from(data)
        stamp_ns = seconds * NS_PER_S + nanoseconds
        if stamp_ns < self.newest:
            # A recording begins again.
            self.stamps.clear()
        self.stamps.append(stamp_ns)
        self.kept[stamp_ns] = data
        self.kept.move_to_end(stamp_ns)
        self.last_s, self.sent_ns = time.monotonic(), info["source_timestamp"]
        while len(self.kept) > KEPT:
            self.kept.popitem(last=False)
