"""The node camera_driver with the source `simulated`, over real topics and services."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseStamped, WrenchStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from cmp_tactile_driver.nodes.camera_driver import CameraDriver
from cmp_tactile_msgs.msg import ForceField, Grid, Surface
from cmp_tactile_processing.ros.messages.reading import (
    force_field_from_msg,
    grid_from_msg,
    stamp_ns,
    surface_from_msg,
)
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_simulation.live.sensor import TruthWanted

SCENE = Path(__file__).parents[1] / "data" / "live_press.yaml"
GEL = "sample_rig_gel_frame"
RADIUS_M = 0.006
# The elastic model is built and the renderer compiled in it.
TIMEOUT_S = 120.0


class Live:
    """The node, and what came on its topics."""

    def __init__(self, ros, **parameters):
        self._ros = ros
        self.images = ros.listen(Image, "image_raw")
        self.poses = ros.listen(PoseStamped, "indenter/pose")
        self.target = ros.node.create_publisher(PoseStamped, "indenter/target", 10)
        self.load = ros.node.create_publisher(WrenchStamped, "indenter/load", 10)
        self.reports = ros.reports("camera_driver")
        given = {"source": "simulated", "input": str(SCENE), "autoplay": False, "max_speed": 0.1}
        self.node = ros.start(CameraDriver, **{**given, **parameters})
        ros.wait(self.target.get_subscription_count, "the subscription of targets")
        ros.wait(self.load.get_subscription_count, "the subscription of loads")

    def wait(self, condition, what):
        self._ros.wait(condition, what, TIMEOUT_S)

    def go_to(self, z, frame=GEL, x=0.0):
        message = PoseStamped()
        message.header.frame_id = frame
        message.pose.position.x, message.pose.position.z = x, z
        self.target.publish(message)

    def press(self, normal, frame=GEL):
        message = WrenchStamped()
        message.header.frame_id = frame
        message.wrench.force.z = -normal
        self.load.publish(message)

    @property
    def z(self):
        return self.poses[-1].pose.position.z if self.poses else np.nan

    @property
    def refused(self):
        """What the diagnostics will report, once a second."""
        return self.node._extension.diagnostics["refused"]


def test_one_of_two_sensors_of_a_description_has_frames_of_its_own(ros):
    """Else targets for both fingers were in a frame that is on no tf tree."""
    live = Live(ros, sensor_name="left_finger")
    live.go_to(RADIUS_M - 0.1e-3)
    live.wait(lambda: live.poses, "the first state")
    assert live.refused.endswith("found 'sample_rig_gel_frame', expected 'left_finger_gel_frame'")
    assert live.poses[0].header.frame_id == "left_finger_gel_frame"


def test_it_moves_to_a_target_and_publishes_what_is_true(ros):
    forces = ros.listen(ForceField, "truth/force_field")
    surfaces = ros.listen(Surface, "truth/surface")
    grids = {v: ros.listen(Grid, f"truth/{v}/grid") for v in ("left", "right")}
    live = Live(ros)
    live.wait(lambda: live.poses, "the first state")
    live.go_to(RADIUS_M - 0.4e-3)
    live.wait(lambda: abs(live.z - (RADIUS_M - 0.4e-3)) < 1e-9, "the target")
    stamp = stamp_ns(live.poses[-1].header.stamp)

    def complete():
        kinds = (live.images, forces, surfaces, *grids.values())
        return all(any(stamp_ns(m.header.stamp) == stamp for m in kind) for kind in kinds)

    live.wait(complete, "all that is true of the frame")
    force, surface, left, right = (
        next(m for m in kind if stamp_ns(m.header.stamp) == stamp)
        for kind in (forces, surfaces, grids["left"], grids["right"])
    )
    shape = load_sensor("sample_rig").pattern.shape
    field = force_field_from_msg(force)
    assert field.wrench[2] < -0.1
    assert field.contact.any()
    pressed_in = np.nanmin(surface_from_msg(surface, shape).displacement[..., 2])
    # Pressed in by 0.7 mm at the top of the skin, which is 0.3 mm thick.
    assert -0.8e-3 < pressed_in < -0.5e-3
    for grid in (left, right):
        assert (grid_from_msg(grid, shape).corner_status == 1).all()
    frames = [m.header.frame_id for m in (live.poses[-1], force, surface, left, right)]
    views = [f"sample_rig_{view}_optical_frame" for view in ("left", "right")]
    assert frames == [GEL, GEL, GEL, *views]


def test_nothing_is_made_true_that_nobody_asks_for(ros):
    live = Live(ros)
    live.wait(lambda: len(live.poses) > 3, "frames")
    source = live.node._source
    assert source.wanted == TruthWanted()
    ros.listen(Surface, "truth/surface")
    live.wait(lambda: source.wanted == TruthWanted(optics=True), "the truth that is asked for")
    ros.listen(ForceField, "truth/force_field")
    live.wait(lambda: source.wanted == TruthWanted(force=True, optics=True), "all of it")


def test_load_and_reset(ros):
    forces = ros.listen(ForceField, "truth/force_field")
    live = Live(ros, max_load_rate=100.0)
    live.wait(lambda: live.poses, "the first state")
    start = live.z
    live.press(1.0)
    live.wait(lambda: forces and abs(forces[-1].wrench.force.z + 1.0) < 0.01, "the load")
    live.wait(lambda: live.z < start - 1e-4, "the place of that load")
    answer = ros.call(Trigger, "indenter/reset", Trigger.Request(), TIMEOUT_S)
    assert answer.success
    assert "live_press" in answer.message
    live.wait(lambda: forces[-1].wrench.force.z == 0 and live.z == start, "the beginning")


def _no_rotation(live):
    message = PoseStamped()
    message.header.frame_id = GEL
    message.pose.orientation.w = 0.0
    live.target.publish(message)


WRONG = {
    "target: header.frame_id: found 'map', expected 'sample_rig_gel_frame'": (
        lambda live: live.go_to(0.005, frame="map")
    ),
    "target: orientation: found a quaternion of length 0, expected 1": _no_rotation,
    "load: force.z: found 1 N, expected less than 0": lambda live: live.press(-1.0),
}


def test_wrong_commands_are_refused_and_the_target_before_them_stays(ros):
    live = Live(ros, max_speed=1e-4)
    live.wait(lambda: live.poses, "the first state")
    start = live.z
    live.go_to(start - 0.5e-3)
    for refused, command in WRONG.items():
        command(live)
        live.wait(lambda text=refused: text in live.refused, refused)
        assert f"{ros.namespace}/indenter/" in live.refused
    live.wait(
        lambda: refused in live.reports.values.get("refused", ""), "the diagnostics to report it"
    )
    live.wait(lambda: live.z < start - 0.1e-3, "the way to the target")
    count = len(live.images)
    live.wait(lambda: len(live.images) > count, "frames")


def test_it_can_be_cleaned_up_and_configured_again(ros):
    live = Live(ros)
    live.wait(lambda: live.poses, "the first state")

    def change(transition):
        request = ChangeState.Request(transition=Transition(id=transition))
        name = "camera_driver/change_state"
        return ros.call(ChangeState, name, request, TIMEOUT_S).success

    assert change(Transition.TRANSITION_DEACTIVATE)
    assert change(Transition.TRANSITION_CLEANUP)
    ros.wait(lambda: not live.target.get_subscription_count(), "the subscription to go")
    assert change(Transition.TRANSITION_CONFIGURE)
    assert change(Transition.TRANSITION_ACTIVATE)
    live.poses.clear()
    live.wait(lambda: live.poses, "the first state again")
