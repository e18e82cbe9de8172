"""The wrench for controllers: frame, sign, filter and rate, and NaN in place of what is not known.

Reports: UniversalRobots/Universal_Robots_ROS2_Driver 235, 572 (in another frame than the message
says), ros-controls/ros2_controllers 2021 (moved into a frame of choice), kroshu/kuka_drivers 177
and cyberbotics/webots_ros2 659 (no WrenchStamped at all), fzi-forschungszentrum-informatik/
cartesian_controllers 123 (what NaN does to a controller: `valid` says so, too).
"""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import TransformStamped, WrenchStamped
from made_forces import made_field
from ros_graph import header_at, stamps_of
from scipy.spatial.transform import Rotation
from std_msgs.msg import Bool
from tf2_ros import StaticTransformBroadcaster

from cmp_tactile_msgs.msg import ForceField as ForceFieldMsg
from cmp_tactile_processing.measured import ForceFlag
from cmp_tactile_processing.nodes.wrench_broadcaster import WrenchBroadcaster
from cmp_tactile_processing.ros.messages.conversions import force_field_to_msg

pytestmark = pytest.mark.ros

MS = 10**6
GEL = "finger_gel_frame"
WRENCH = np.array([0.5, -0.2, -3.0, 0.004, -0.002, 0.001])


def six(message):
    force, torque = message.wrench.force, message.wrench.torque
    return np.array([force.x, force.y, force.z, torque.x, torque.y, torque.z])


class Broadcast:
    """Publishes forces, and listens to what the node makes of them."""

    def __init__(self, ros, **parameters):
        self.ros = ros
        self.node = ros.start(WrenchBroadcaster, **{"timeout": 60.0, **parameters})
        self.wrenches = ros.listen(WrenchStamped, "wrench_broadcaster/wrench")
        self.valid = ros.listen(Bool, "wrench_broadcaster/valid", latched=True)
        ros.wait_subscribed(self.node, "wrench_broadcaster/wrench", "wrench_broadcaster/valid")
        self._publisher = ros.publisher(ForceFieldMsg, "force_field")

    def publish(self, stamp_ms, wrench=WRENCH, **fields):
        field = made_field(3, 3, wrench=np.array(wrench, float), **fields)
        self._publisher.publish(force_field_to_msg(field, header_at(stamp_ms * MS, GEL)))

    def answer(self, stamp_ms, wrench=WRENCH, **fields):
        """What comes of a force."""
        count = len(self.wrenches)
        self.publish(stamp_ms, wrench, **fields)
        self.ros.wait(lambda: len(self.wrenches) > count, "a wrench")
        return self.wrenches[-1]

    @property
    def is_valid(self):
        return [message.data for message in self.valid]


def test_without_a_frame_it_is_the_wrench_about_the_origin_of_the_gel_frame(ros):
    reference = np.array([0.01, 0.02, -0.03])
    found = Broadcast(ros).answer(1000, reference_point=reference)
    assert (found.header.frame_id, stamps_of([found])) == (GEL, [1000 * MS])
    moved = WRENCH[3:] + np.cross(reference, WRENCH[:3])
    np.testing.assert_allclose(six(found), [*WRENCH[:3], *moved], atol=1e-12)


@pytest.mark.parametrize(("force_on", "sign"), [("sensor", 1), ("object", -1)])
def test_force_and_moment_are_moved_to_the_frame_of_a_robot(ros, force_on, sign):
    """A fingertip that is turned by 90 degrees about x, 0.1 m out along y of the tool."""
    mount = TransformStamped(child_frame_id=GEL)
    mount.header.frame_id = "tool0"
    mount.transform.translation.y = 0.1
    turn = Rotation.from_euler("x", 90, degrees=True)
    q = mount.transform.rotation
    q.x, q.y, q.z, q.w = turn.as_quat().tolist()
    broadcast = Broadcast(ros, frame_id="tool0", force_on=force_on)
    found = broadcast.answer(1000)
    assert np.isnan(six(found)).all(), "tf knows nothing yet"
    StaticTransformBroadcaster(ros.node).sendTransform(mount)
    ros.wait(lambda: broadcast.node._poses.find("tool0", GEL) is not None, "the transform")
    found = broadcast.answer(1100)
    force = turn.apply(WRENCH[:3])
    moment = turn.apply(WRENCH[3:]) + np.cross([0, 0.1, 0], force)
    np.testing.assert_allclose(six(found), sign * np.array([*force, *moment]), atol=1e-12)
    assert found.header.frame_id == "tool0"
    ros.wait(lambda: broadcast.is_valid == [False, True], "validity")


def test_the_filter_is_of_first_order_whatever_the_rate_of_frames(ros):
    """A step, and frames that come unevenly: exact in each of them."""
    cutoff = 2.0
    broadcast = Broadcast(ros, filter_cutoff=cutoff)
    first = six(broadcast.answer(1000, np.zeros(6)))
    np.testing.assert_array_equal(first, 0)
    for stamp_ms in (1010, 1043, 1050, 1200, 1900):
        share = 1 - np.exp(-2 * np.pi * cutoff * (stamp_ms - 1000) / 1000)
        np.testing.assert_allclose(six(broadcast.answer(stamp_ms)), share * WRENCH, atol=1e-12)


def test_a_force_that_cannot_be_used_is_nan_at_once_and_the_filter_begins_again(ros):
    reports = ros.reports("wrench_broadcaster")
    broadcast = Broadcast(ros, filter_cutoff=0.01, rate=0.1)
    broadcast.publish(1000)
    ros.wait(lambda: broadcast.is_valid == [True], "validity")
    assert not broadcast.wrenches, "its time has not come"
    found = broadcast.answer(1033, flags=ForceFlag.POOR_FIT)
    assert np.isnan(six(found)).all()
    assert stamps_of([found]) == [1033 * MS]
    ros.wait(lambda: broadcast.is_valid == [True, False], "validity")
    ros.wait(lambda: "cannot be used: poor_fit" in reports.last.message, "a report")
    assert reports.last.level == b"\x02"
    ros.set_parameters("wrench_broadcaster", {"rate": 0.0})
    assert np.isnan(six(broadcast.answer(1066, np.full(6, np.nan)))).all()
    np.testing.assert_allclose(six(broadcast.answer(1100)), WRENCH)
    # That the contact is at the edge does not make it useless.
    assert np.isfinite(six(broadcast.answer(1133, flags=ForceFlag.AT_BORDER))).all()


def test_after_the_timeout_there_is_nan_and_never_the_last_wrench(ros):
    broadcast = Broadcast(ros, timeout=0.3, rate=50.0)
    broadcast.publish(1000)
    ros.wait(lambda: any(np.isfinite(six(item)).all() for item in broadcast.wrenches), "a wrench")
    ros.wait(lambda: broadcast.is_valid[-2:] == [True, False], "the timeout")
    ros.run(0.1)
    end = len(broadcast.wrenches)
    ros.run(0.5)
    late = broadcast.wrenches[end:]
    assert len(late) > 5
    assert np.isnan([six(item) for item in late]).all()
    assert late[-1].header.frame_id == GEL
    assert stamps_of(late)[-1] > 1000 * MS
    broadcast.publish(2000)
    ros.wait(lambda: broadcast.is_valid[-1], "a force")


def test_the_rate_is_that_of_the_parameter(ros):
    """Slower than the frames: the newest.  Its stamp is that of its frame."""
    broadcast = Broadcast(ros, rate=5.0)
    for number in range(40):
        broadcast.publish(1000 + 25 * number, number * np.ones(6))
        ros.run(0.025)
    ros.wait(lambda: broadcast.wrenches and six(broadcast.wrenches[-1])[0] == 39, "the last")
    assert 3 <= len(broadcast.wrenches) <= 15
    for item in broadcast.wrenches:
        assert six(item)[0] == (stamps_of([item])[0] // MS - 1000) / 25
