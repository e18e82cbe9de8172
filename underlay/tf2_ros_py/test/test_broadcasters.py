"""Transforms reach a listener over a real graph; static ones reach those who come late, all."""

from functools import partial

import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not there")

from geometry_msgs.msg import TransformStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage
from tf2_ros import StaticTransformBroadcaster, TransformBroadcaster
from tf2_ros.static_transform_broadcaster import StaticTransformBroadcaster as StaticInItsModule
from tf2_ros.transform_broadcaster import TransformBroadcaster as InItsModule
from waiting import wait_until

pytestmark = pytest.mark.ros

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Graph:
    """A sender, and listeners that may join later."""

    def __init__(self):
        self.context = Context()
        rclpy.init(context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.sender = self.add_node("sender")

    def add_node(self, name):
        node = rclpy.create_node(name, context=self.context)
        self.executor.add_node(node)
        return node

    def listen(self, topic, qos):
        """Messages that a new node receives on the topic, as they come."""
        received = []
        node = self.add_node(f"listener_{len(self.executor.get_nodes())}")
        node.create_subscription(TFMessage, topic, received.append, qos)
        return received

    def spin_until(self, condition):
        step = partial(self.executor.spin_once, timeout_sec=0.05)
        wait_until(condition, "transforms", step=step)


@pytest.fixture
def graph():
    graph = Graph()
    yield graph
    for node in graph.executor.get_nodes():
        node.destroy_node()
    graph.executor.shutdown()
    rclpy.shutdown(context=graph.context)


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


def test_one_and_several_moving_transforms(graph):
    received = graph.listen("/tf", QoSProfile(depth=10))
    broadcaster = TransformBroadcaster(graph.sender)
    graph.spin_until(lambda: broadcaster.pub_tf.get_subscription_count() == 1)
    broadcaster.sendTransform(transform("one", 1.5))
    broadcaster.sendTransform([transform("two"), transform("three")])
    graph.spin_until(lambda: len(received) == 2)
    assert received[0].transforms == [transform("one", 1.5)]
    assert children(received[1]) == ["two", "three"]


def test_a_late_listener_gets_every_static_transform(graph):
    broadcaster = StaticTransformBroadcaster(graph.sender)
    broadcaster.sendTransform(transform("left"))
    broadcaster.sendTransform((transform("right"), transform("camera")))
    received = graph.listen("/tf_static", LATCHED)
    graph.spin_until(lambda: received)
    assert children(received[-1]) == ["left", "right", "camera"]


def test_a_static_transform_sent_again_replaces_the_first(graph):
    broadcaster = StaticTransformBroadcaster(graph.sender)
    broadcaster.sendTransform([transform("left", 1.0), transform("right", 2.0)])
    broadcaster.sendTransform(transform("left", 3.0))
    received = graph.listen("/tf_static", LATCHED)
    graph.spin_until(lambda: received)
    places = {t.child_frame_id: t.transform.translation.x for t in received[-1].transforms}
    assert places == {"left": 3.0, "right": 2.0}


def test_the_depth_can_be_chosen(graph):
    broadcaster = TransformBroadcaster(graph.sender, 3)
    (info,) = graph.sender.get_publishers_info_by_topic("/tf")
    assert broadcaster.pub_tf.topic_name == "/tf"
    assert info.topic_type == "tf2_msgs/msg/TFMessage"
