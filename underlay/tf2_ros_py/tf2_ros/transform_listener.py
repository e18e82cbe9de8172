"""Fills a buffer from the topics of transforms."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

from tf2_ros.buffer import Buffer


class TransformListener:
    """Subscribes to /tf and /tf_static; the node has to be spun."""

    def __init__(self, buffer: Buffer, node: Node) -> None:
        self.buffer = buffer
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.tf_sub = node.create_subscription(TFMessage, "/tf", self._take, QoSProfile(depth=100))
        self.tf_static_sub = node.create_subscription(TFMessage, "/tf_static", self._take, latched)

    def _take(self, message: TFMessage) -> None:
        for transform in message.transforms:
            self.buffer.set_transform(transform, "")
