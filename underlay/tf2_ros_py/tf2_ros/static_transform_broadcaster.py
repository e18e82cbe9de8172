"""Broadcaster of transforms that hold for good."""

from __future__ import annotations

from collections.abc import Iterable

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile
from tf2_msgs.msg import TFMessage


class StaticTransformBroadcaster:
    """Publishes transforms on /tf_static, latched.

    A latched topic keeps its last message alone, so each message repeats all transforms that this
    broadcaster has sent.
    """

    def __init__(self, node: Node, qos: QoSProfile | int | None = None) -> None:
        """qos: profile or depth of the publisher; reliable, transient local, depth 1 if None."""
        profile: QoSProfile | int = (
            QoSProfile(
                depth=1,
                durability=DurabilityPolicy.TRANSIENT_LOCAL,
                history=HistoryPolicy.KEEP_LAST,
            )
            if qos is None
            else qos
        )
        self.pub_tf = node.create_publisher(TFMessage, "/tf_static", profile)
        self._by_child: dict[str, TransformStamped] = {}

    def sendTransform(self, transform: TransformStamped | Iterable[TransformStamped]) -> None:  # noqa: N802
        """Add one transform or several to those sent before, and publish them all."""
        transforms = [transform] if isinstance(transform, TransformStamped) else transform
        self._by_child.update((each.child_frame_id, each) for each in transforms)
        self.pub_tf.publish(TFMessage(transforms=list(self._by_child.values())))
