"""The node of a live grasp, through real rclpy and DDS."""

from __future__ import annotations

import math

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy")
pytest.importorskip("mujoco")
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker

from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.ros.messages.reading import stamp_ns
from cmp_tactile_simulation.grasp.scene import packaged_grasps
from cmp_tactile_simulation.nodes.grasp_simulator import GraspSimulator

pytestmark = pytest.mark.ros
SIDES = ("left_finger", "right_finger")


@pytest.fixture
def scene(tmp_path):
    """The packaged box at 20 Hz."""
    content = yaml.safe_load(packaged_grasps()["box"].read_text(encoding="utf-8"))
    path = tmp_path / "box.yaml"
    path.write_text(yaml.safe_dump({**content, "rate": 20, "contact_nodes": 16}, sort_keys=False))
    return str(path)


def test_frames_poses_and_clock_of_one_moment_come_with_one_stamp(ros, scene):
    images = {side: ros.listen(Image, f"{side}/image_raw") for side in SIDES}
    infos = {side: ros.listen(CameraInfo, f"{side}/camera_info") for side in SIDES}
    truths = {side: ros.listen(WrenchStamped, f"{side}/truth/wrench") for side in SIDES}
    poses, transforms = ros.listen(PoseStamped, "object/pose"), ros.listen(TFMessage, "/tf")
    clocks, openings = ros.listen(Clock, "/clock"), ros.listen(Float64, "gripper/opening")
    ros.start(GraspSimulator, scene=scene)
    markers = ros.listen(Marker, "object/marker", latched=True)
    stamped = [*images.values(), *infos.values(), *truths.values(), poses]
    ros.wait(lambda: min(map(len, stamped)) >= 4, "frames", timeout_s=300)
    stamps = [stamp_ns(item.header.stamp) for item in images[SIDES[0]]][:4]
    assert np.diff(stamps) == pytest.approx(5e7)
    for found in stamped:
        assert [stamp_ns(item.header.stamp) for item in found[:4]] == stamps
    assert images[SIDES[1]][0].header.frame_id == "right_finger_camera_optical_frame"
    assert {stamp_ns(item.clock) for item in clocks} >= set(stamps)
    parents = {item.child_frame_id: item.header.frame_id for item in transforms[0].transforms}
    assert parents == {
        "gripper": "world",
        "object": "world",
        "left_finger_gel_frame": "gripper",
        "right_finger_gel_frame": "gripper",
    }
    places = {item.child_frame_id: item.transform for item in transforms[0].transforms}
    # The marker is the box of 40 x 30 x 60 mm.
    points = np.array([(item.x, item.y, item.z) for item in markers[0].points])
    assert markers[0].header.frame_id == "object"
    assert np.ptp(points, axis=0) == pytest.approx([0.04, 0.03, 0.06])
    half = places["left_finger_gel_frame"].translation.y
    assert half == pytest.approx(-places["right_finger_gel_frame"].translation.y)
    assert 2 * half == pytest.approx(openings[0].data)


def test_commands_move_the_fingers_and_wrong_ones_do_not(ros, scene):
    openings = ros.listen(Float64, "gripper/opening")
    ros.start(GraspSimulator, scene=scene, drive="command")
    command = ros.publisher(Float64, "gripper/command")
    controls = ros.publisher(JointState, "gripper/controls")
    poses = ros.listen(TFMessage, "/tf")
    ros.wait(lambda: openings, "the gripper", timeout_s=300)
    begin = openings[-1].data

    def reached(opening):
        command.publish(Float64(data=opening))
        return abs(openings[-1].data - opening) < 1e-5

    def height():
        return poses[-1].transforms[0].transform.translation.z

    ros.wait(lambda: reached(begin - 0.003), "the command")
    command.publish(Float64(data=math.nan))
    before = height()
    controls.publish(JointState(name=["lift"], position=[math.nan]))
    controls.publish(JointState(name=["lift", "no_such"], position=[0.01, 1.0]))
    ros.run(0.3)
    assert openings[-1].data == pytest.approx(begin - 0.003, abs=1e-5)
    assert height() == pytest.approx(before, abs=1e-4)

    low = height()

    def lifted():
        controls.publish(JointState(name=["lift"], position=[0.01]))
        return height() > low + 0.009

    ros.wait(lifted, "the hand")


def test_a_grasp_that_fails_is_reported_and_begins_again(ros, scene):
    """A hand that presses with 10 N, and then jerks by more than a gel can follow."""
    reports = ros.listen(DiagnosticArray, "/diagnostics")
    ros.start(GraspSimulator, scene=scene)
    openings = ros.listen(Float64, "gripper/opening")
    controls = ros.publisher(JointState, "gripper/controls")
    ros.wait(lambda: openings, "the gripper", timeout_s=300)
    begin = openings[-1].data

    def reported():
        given = {"grip_left": 0.02, "grip_right": 0.02}
        if openings[-1].data < 0.0292:
            given["shake"] = 1.0
        controls.publish(JointState(name=[*given], position=[*given.values()]))
        statuses = [status for report in reports for status in report.status]
        return any("found a motion" in status.message for status in statuses)

    ros.wait(reported, "the report")
    # What is published until then moves the fingers again.
    answer = ros.call(Trigger, "grasp_simulator/restart", Trigger.Request())
    assert answer.success
    ros.wait(lambda: abs(openings[-1].data - begin) < 1e-4, "that it begins again")


@pytest.mark.parametrize(
    ("parameters", "found"),
    [({"scene": "nowhere"}, "nowhere"), ({"sensor_names": "one"}, "sensor_names")],
)
def test_wrong_parameters_are_refused(ros, parameters, found):
    with pytest.raises(CmpTactileError, match=found):
        ros.start(GraspSimulator, **parameters)
