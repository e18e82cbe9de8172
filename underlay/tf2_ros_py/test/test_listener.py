"""Transforms that a listener took from a real graph, against the product of their matrices."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from geometry_msgs.msg import TransformStamped
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from tf2_ros import (
    Buffer,
    StaticTransformBroadcaster,
    TransformBroadcaster,
    TransformException,
    TransformListener,
)

pytestmark = pytest.mark.ros


def transform(parent, child, matrix):
    stamped = TransformStamped(child_frame_id=child)
    stamped.header.frame_id = parent
    place, turn = stamped.transform.translation, stamped.transform.rotation
    place.x, place.y, place.z = matrix[:3, 3].tolist()
    quaternion = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    turn.x, turn.y, turn.z, turn.w = quaternion.tolist()
    return stamped


def matrix_of(stamped):
    place, turn = stamped.transform.translation, stamped.transform.rotation
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    T[:3, 3] = place.x, place.y, place.z
    return T


def any_pose(seed):
    random = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = random.normal(size=3)
    return T


def test_frames_are_connected_over_their_common_parent(ros):
    T_world_hand, T_hand_left, T_hand_right = map(any_pose, range(3))
    buffer = Buffer()
    listener = TransformListener(buffer, ros.node)
    assert listener.buffer is buffer
    static = StaticTransformBroadcaster(ros.node)
    static.sendTransform([
        transform("hand", "left", T_hand_left), transform("hand", "right", T_hand_right)
    ])  # fmt: skip
    moving = TransformBroadcaster(ros.node)
    ros.wait(lambda: moving.pub_tf.get_subscription_count() == 1, "the listener")
    moving.sendTransform(transform("world", "hand", T_world_hand))

    def known(target, source):
        try:
            return buffer.lookup_transform(target, source, Time())
        except TransformException:
            return None

    ros.wait(lambda: known("world", "left") and known("left", "right"), "transforms")
    np.testing.assert_allclose(matrix_of(known("world", "left")), T_world_hand @ T_hand_left)
    between = np.linalg.inv(T_hand_left) @ T_hand_right
    found = known("left", "right")
    np.testing.assert_allclose(matrix_of(found), between, atol=1e-12)
    assert (found.header.frame_id, found.child_frame_id) == ("left", "right")
    assert known("world", "nowhere") is None
    with pytest.raises(TransformException):
        buffer.lookup_transform("world", "left", Time(seconds=1))


def test_a_circle_of_frames_ends():
    buffer = Buffer()
    for parent, child in (("a", "b"), ("b", "a")):
        buffer.set_transform(transform(parent, child, np.eye(4)), "test")
    with pytest.raises(TransformException):
        buffer.lookup_transform("c", "a", Time())
