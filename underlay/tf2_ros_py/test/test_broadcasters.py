"""Transforms reach a listener over a real graph; static ones reach those who come late, all."""

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage
from tf2_ros import StaticTransformBroadcaster, TransformBroadcaster
from tf2_ros.static_transform_broadcaster import StaticTransformBroadcaster as StaticInItsModule
from tf2_ros.transform_broadcaster import TransformBroadcaster as InItsModule

pytestmark = pytest.mark.ros


def transform(child, x=0.0):
    stamped = TransformStamped(child_frame_id=child)
    stamped.header.frame_id = "finger_gel_frame"
    stamped.transform.translation.x = x
    return stamped


def children(message):
    return [each.child_frame_id for each in message.transforms]


def test_the_classes_lie_in_the_modules_of_the_real_package():
    assert InItsModule is TransformBroadcaster
    assert StaticInItsModule is StaticTransformBroadcaster


def test_one_and_several_moving_transforms(ros):
    received = ros.listen(TFMessage, "/tf")
    broadcaster = TransformBroadcaster(ros.node)
    ros.wait(lambda: broadcaster.pub_tf.get_subscription_count() == 1, "transforms")
    broadcaster.sendTransform(transform("one", 1.5))
    broadcaster.sendTransform([transform("two"), transform("three")])
    ros.wait(lambda: len(received) == 2, "transforms")
    assert received[0].transforms == [transform("one", 1.5)]
    assert children(received[1]) == ["two", "three"]


def test_a_late_listener_gets_every_static_transform(ros):
    broadcaster = StaticTransformBroadcaster(ros.node)
    broadcaster.sendTransform(transform("left"))
    broadcaster.sendTransform((transform("right"), transform("camera")))
    received = ros.listen(TFMessage, "/tf_static", latched=True)
    ros.wait(lambda: received, "transforms")
    assert children(received[-1]) == ["left", "right", "camera"]


def test_a_static_transform_sent_again_replaces_the_first(ros):
    broadcaster = StaticTransformBroadcaster(ros.node)
    broadcaster.sendTransform([transform("left", 1.0), transform("right", 2.0)])
    broadcaster.sendTransform(transform("left", 3.0))
    received = ros.listen(TFMessage, "/tf_static", latched=True)
    ros.wait(lambda: received, "transforms")
    places = {t.child_frame_id: t.transform.translation.x for t in received[-1].transforms}
    assert places == {"left": 3.0, "right": 2.0}


def test_the_depth_can_be_chosen(ros):
    broadcaster = TransformBroadcaster(ros.node, 3)
    (info,) = ros.node.get_publishers_info_by_topic("/tf")
    assert broadcaster.pub_tf.topic_name == "/tf"
    assert info.topic_type == "tf2_msgs/msg/TFMessage"
