"""The state of a grasp from the forces of two fingers over DDS, and none where one is missing."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import TransformStamped
from made_forces import made_field
from ros_graph import header_at, stamps_of
from scipy.spatial.transform import Rotation
from tf2_ros import StaticTransformBroadcaster
from visualization_msgs.msg import MarkerArray

from cmp_tactile_msgs.msg import ForceField as ForceFieldMsg
from cmp_tactile_msgs.msg import GraspState as GraspStateMsg
from cmp_tactile_processing.measured import SlipEstimate, SlipState
from cmp_tactile_processing.nodes.grasp_state import GraspStateEstimator
from cmp_tactile_processing.ros.messages.conversions import force_field_to_msg

pytestmark = pytest.mark.ros

MS = 10**6
FRAMES = {"left": "left_gel_frame", "right": "right_gel_frame"}
# As the packaged gripper mounts its fingers; then the tool stands on its head.
MOUNTS = {"left": ([0, 0.02, 0], [np.pi / 2, 0, 0]), "right": ([0, -0.02, 0], [-np.pi / 2, 0, 0])}


def transform(parent, child, place, angles):
    found = TransformStamped(child_frame_id=child)
    found.header.frame_id = parent
    by, turn = found.transform.translation, found.transform.rotation
    by.x, by.y, by.z = map(float, place)
    turn.x, turn.y, turn.z, turn.w = Rotation.from_euler("xyz", angles).as_quat().tolist()
    return found


class Fingers:
    """Publishes forces of both fingers, and listens to the node."""

    def __init__(self, ros, *, mounted=True, **parameters):
        self.ros = ros
        broadcaster = StaticTransformBroadcaster(ros.node)
        if mounted:
            mounts = [transform("gripper", FRAMES[side], *MOUNTS[side]) for side in FRAMES]
            broadcaster.sendTransform(
                [*mounts, transform("world", "gripper", [0, 0, 1], [np.pi, 0, 0])]
            )
        self.node = ros.start(GraspStateEstimator, **{"timeout": 60.0, **parameters})
        self.states = ros.listen(GraspStateMsg, "grasp_state")
        ros.wait_subscribed(self.node, "grasp_state")
        self._publishers = {
            side: ros.publisher(ForceFieldMsg, f"{side}/force_field") for side in FRAMES
        }
        if mounted:
            known = self.node._poses
            ros.wait(lambda: known.find("world", FRAMES["right"]) is not None, "transforms")

    def publish(self, side, stamp_ms, along=0.0, **fields):
        """A press of 3 N by a finger that carries 0.5 N along y of its gel, by default."""
        given = {
            "wrench": np.array([along, 0.5, -3.0, 0.0, 0.0, 0.0]),
            "wrench_covariance": np.diag([1e-4] * 3 + [1e-9] * 3),
            "systematic_covariance": np.zeros((6, 6)),
            "centre_of_pressure": np.zeros(3),
            "slip": SlipEstimate(SlipState.STICK),
            "slip_state": SlipState.STICK,
            **fields,
        }
        header = header_at(round(stamp_ms * MS), FRAMES[side])
        self._publishers[side].publish(force_field_to_msg(made_field(3, 3, **given), header))

    def pair(self, stamp_ms, **fields):
        """The state after forces of both fingers."""
        count = len(self.states)
        for side in FRAMES:
            self.publish(side, stamp_ms, **fields)
        self.ros.wait(lambda: len(self.states) > count, "a state")
        return self.states[-1]


def test_two_forces_give_one_state(ros):
    fingers = Fingers(ros, friction=0.5)
    shown = ros.listen(MarkerArray, "grasp_markers")
    ros.wait_subscribed(fingers.node, "grasp_markers")
    state = fingers.pair(1000)
    assert (state.header.frame_id, stamps_of([state])) == ("gripper", [1000 * MS])
    assert state.usable
    assert state.grip_force == pytest.approx(3.0)
    assert state.grip_force_std == pytest.approx(np.sqrt(2e-4) / 2)
    assert list(state.normal_force) == [3.0, 3.0]
    axis, load = state.grip_axis, state.load.force
    np.testing.assert_allclose([axis.x, axis.y, axis.z], [0, -1, 0], atol=1e-7)
    # y of the left gel is z of the gripper, that of the right one its opposite.
    np.testing.assert_allclose([load.x, load.y, load.z], 0, atol=1e-6)
    assert state.slip_margin == pytest.approx(1 - 0.5 / 3.0 / 0.5)
    assert state.slip_state == ForceFieldMsg.SLIP_STICK
    ros.wait(lambda: shown, "markers")
    texts = [marker.text for marker in shown[-1].markers if marker.text]
    assert texts == ["grip 3.0 N, margin 67 %"]


def test_the_weight_is_along_the_vertical_of_the_world(ros):
    """The hand hangs upside down: what pulls along its z pulls upwards on the fingers' side."""
    fingers = Fingers(ros)
    for stamp_ms in range(1000, 2200, 100):
        fingers.publish("left", stamp_ms, wrench=np.array([0, 0.7, -3.0, 0, 0, 0]))
        fingers.publish("right", stamp_ms, wrench=np.array([0, -0.8, -3.0, 0, 0, 0]))
    ros.wait(lambda: len(fingers.states) == 12, "states")
    last = fingers.states[-1]
    assert last.load.force.z == pytest.approx(1.5, abs=1e-6)
    assert last.supported_weight == pytest.approx(1.5, abs=1e-6)
    assert last.supported_weight_std == pytest.approx(np.sqrt(2e-4), rel=1e-3)
    assert np.isnan(fingers.states[5].supported_weight)


def test_forces_are_paired_by_the_nearest_stamps(ros):
    """Cameras of 30 Hz that are not exposed together, and a force that comes late."""
    fingers = Fingers(ros)
    for side, stamp_ms in (
        ("left", 0), ("right", 10), ("left", 33), ("left", 67), ("right", 43), ("right", 77),
        ("left", 100), ("right", 210), ("left", 200),
    ):  # fmt: skip
        fingers.publish(side, 1000 + stamp_ms)
        ros.run(0.05)
    ros.wait(lambda: len(fingers.states) >= 4, "states")
    ros.run(0.2)
    stamps = [stamp // MS - 1000 for stamp in stamps_of(fingers.states)]
    assert stamps == [10, 43, 77, 210]


def test_all_is_nan_and_stale_when_a_finger_stops(ros):
    """A controller must never see the last value again."""
    reports = ros.reports("grasp_state")
    fingers = Fingers(ros, timeout=0.3)
    fingers.ros.wait(lambda: fingers.states, "a stale state before the first pair")
    assert fingers.states[-1].flags == GraspStateMsg.FLAG_STALE
    for side in FRAMES:
        fingers.publish(side, 1000)
    ros.wait(lambda: any(state.usable for state in fingers.states), "a state")
    end = len(fingers.states)
    for number in range(30):
        fingers.publish("left", 1100 + 100 * number)
        ros.run(0.05)
    assert len(fingers.states) > end
    assert {state.flags for state in fingers.states[end:]} == {GraspStateMsg.FLAG_STALE}
    stale = fingers.states[-1]
    assert not stale.usable
    values = [stale.grip_force, *stale.normal_force, stale.load.force.z, stale.slip_margin]
    assert np.isnan(values).all()
    ros.wait(lambda: "no pair of forces for 0.3 s" in reports.last.message, "a report")
    assert reports.last.level == b"\x02"


def test_all_is_nan_while_tf_does_not_know_the_fingers(ros):
    reports = ros.reports("grasp_state")
    state = Fingers(ros, mounted=False).pair(1000)
    assert state.flags == GraspStateMsg.FLAG_NO_TRANSFORM
    assert np.isnan(state.grip_force)
    ros.wait(lambda: "no transform from" in reports.last.message, "a report")


def test_parameters_change_while_it_runs(ros):
    fingers = Fingers(ros)
    assert np.isnan(fingers.pair(1000).slip_margin)
    ros.set_parameters("grasp_state", {"friction": 0.5, "up_frame": "nowhere"})
    state = fingers.pair(1100)
    assert state.slip_margin == pytest.approx(2 / 3)
    assert state.flags == GraspStateMsg.FLAG_NO_UP
