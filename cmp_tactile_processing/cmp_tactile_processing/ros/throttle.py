"""Results for those who only look: the first frame of each period, on `<topic>_throttle`.

A message costs the stage that makes it more than the one who reads it, so it is made less often for
a viewer than for a controller.  Frames are chosen by their stamps: all stages choose the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from cmp_tactile_processing.ros.intra_process import Result, publish_result
from cmp_tactile_processing.ros.messages.reading import stamp_ns

if TYPE_CHECKING:
    from cmp_tactile_processing.ros.base_nodes import StageNode

# Whole parts of one another: a frame with an image has a surface, too.
RESULT_HZ, IMAGE_HZ = 30, 10
DEPTH = 2


def throttled(topic: str) -> str:
    """Name of the topic with fewer messages; as that of topic_tools."""
    return f"{topic}_throttle"


class ThrottledTopic:
    """A topic's companion with fewer messages, which costs nothing while nobody subscribes."""

    def __init__(self, node: StageNode, message_type: type, topic: str, rate_hz: int) -> None:
        self._publisher = node.add_publisher(message_type, throttled(topic), DEPTH)
        self._rate_hz, self._period = rate_hz, -1

    def offer(self, header: Any, make: Callable[[], Any]) -> None:
        """Publish the message of a frame if it is the first of its period."""
        period = stamp_ns(header.stamp) * self._rate_hz // 10**9
        if period == self._period:
            return
        self._period = period
        if self._publisher.get_subscription_count():
            self._publisher.publish(make())


class ResultPublisher:
    """Publishes what a stage made of each frame, and less often on the throttled topic."""

    def __init__(
        self,
        node: StageNode,
        message_type: type,
        topic: str,
        to_msg: Callable[[Any, Any], Any],
        rate_hz: int = RESULT_HZ,
    ) -> None:
        """to_msg: makes a message of a result and a header.  rate_hz: of the throttled topic."""
        self._publisher = node.add_publisher(message_type, topic)
        self._throttled = ThrottledTopic(node, message_type, topic, rate_hz)
        self._to_msg = to_msg

    @property
    def topic_name(self) -> str:
        """Of the topic with all messages, resolved."""
        return str(self._publisher.topic_name)

    def publish(self, value: Any, header: Any) -> None:
        """Publish a result, which nobody may change any more."""
        result = Result(value, header, self._to_msg)
        publish_result(self._publisher, result)
        self._throttled.offer(header, result.message)
