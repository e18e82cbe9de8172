"""Sensors that run on topics: what the page gets of them, what it costs them, what buttons do."""

import math
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import rclpy
from ros_graph import header_at

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from tf2_ros import StaticTransformBroadcaster
from visualization_msgs.msg import Marker

from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_msgs.msg import ForceField, GraspState, Grid, Surface
from cmp_tactile_processing.errors import CmpTactileError, Finding, InputError, Severity
from cmp_tactile_processing.nodes.stereo_triangulator import StereoTriangulator
from cmp_tactile_processing.ros.base_nodes import latched_qos
from cmp_tactile_processing.ros.messages.conversions import (
    ROS_MESSAGES,
    force_field_to_msg,
    grid_to_msg,
    image_to_msg,
    surface_to_msg,
)
from cmp_tactile_viewer.nodes import controls
from cmp_tactile_viewer.nodes.live_sensors import LiveSensors
from cmp_tactile_viewer.nodes.web_viewer import WebViewer, WebViewerParameters, running_sensors
from cmp_tactile_viewer.snapshot import Pose, Snapshot

pytestmark = pytest.mark.ros

TOPICS = ("image_raw", "left/grid", "right/grid", "surface", "force_field", "wrench")


class Audience:
    """What a source gives."""

    def __init__(self) -> None:
        self.snapshots: list[Snapshot] = []
        self.health: list[Finding] = []

    def show(self, sensor: str, snapshot: Snapshot) -> None:
        assert sensor == "thumb"
        self.snapshots.append(snapshot)

    def show_health(self, lines: list[Finding]) -> None:
        self.health = lines


class Rig:
    """A sensor of which the test publishes what it wants, and what the page gets of it."""

    def __init__(self, ros: Any, description: str, scene_frame: str = "") -> None:
        self.ros, self.description = ros, description
        given = WebViewerParameters(sensor_descriptions=description, sensor_names="thumb")
        grasp, sensors = f"{ros.namespace}/grasp_state", running_sensors(given, ros.namespace)
        self.live = LiveSensors(ros.node, sensors, grasp=grasp, scene_frame=scene_frame)
        self.audience = Audience()
        self.action = {item.label: item.run for item in self.live.actions()["thumb"]}

    def subscriptions(self) -> int:
        count = self.ros.node.count_subscribers
        return sum(count(f"{self.ros.namespace}/{topic}") for topic in TOPICS)

    def look(self) -> None:
        self.live.start(self.audience)
        self.ros.wait(lambda: self.subscriptions() == len(TOPICS), "its subscriptions")

    def says(self, text: str) -> Finding:
        """The line of the health list with a text."""

        def found() -> list[Finding]:
            return [line for line in self.audience.health if text in line.text]

        self.ros.wait(found, f"{text!r} in the health list")
        return found()[0]

    def do(self, action: Callable[[], Any]) -> Any:
        """What an action of the page's thread returns or raises."""
        done: list[Any] = []

        def run() -> None:
            try:
                done.append(action())
            except CmpTactileError as error:
                done.append(error)

        thread = threading.Thread(target=run)
        thread.start()
        self.ros.wait(lambda: not thread.is_alive(), "the end of an action")
        return done[0]


@pytest.fixture
def rig(ros, grasp_bag):
    return Rig(ros, str(grasp_bag / "sensor.yaml"))


def test_it_subscribes_only_while_somebody_looks(rig, ros):
    ros.run(0.1)
    assert rig.subscriptions() == 0
    rig.look()
    rig.live.pause()
    ros.wait(lambda: rig.subscriptions() == 0, "the end of its subscriptions")


def test_the_last_browser_may_leave_after_the_node_has_gone(ros, grasp_bag):
    node = rclpy.create_node("page", context=ros.node.context)
    given = WebViewerParameters(sensor_descriptions=str(grasp_bag / "sensor.yaml"))
    live = LiveSensors(node, running_sensors(given, ros.namespace))
    live.start(Audience())
    node.destroy_node()
    live.pause()


def test_the_state_of_a_grasp_is_a_line(rig, ros):
    rig.look()
    grasps = ros.publisher(GraspState, "grasp_state")

    def said(text, **values):
        grasps.publish(GraspState(**values))
        ros.run(0.05)
        return any(text in line.text for line in rig.audience.health)

    known = {"usable": True, "grip_force": 3.0, "slip_margin": 0.4, "supported_weight": math.nan}
    ros.wait(lambda: said("grip 3.0 N, margin 40 %", **known), "the grasp")
    ros.wait(lambda: said("of both fingers are not known", usable=False), "the warning")


def test_what_belongs_to_a_frame_comes_together(rig, ros, snapshots):
    """The force comes last: a frame is shown when it is there, with the surface it is of."""
    rig.look()
    surfaces = ros.publisher(Surface, "surface")
    forces = ros.publisher(ForceField, "force_field")
    shown = snapshots[-1]
    surfaces.publish(surface_to_msg(shown.surface, header_at(1)))
    ros.wait(lambda: rig.audience.snapshots, "the surface alone")
    assert rig.audience.snapshots[0].force is None
    forces.publish(force_field_to_msg(shown.force, header_at(1)))
    ros.wait(lambda: len(rig.audience.snapshots) == 2, "both")
    surfaces.publish(surface_to_msg(snapshots[0].surface, header_at(2)))
    ros.run(0.3)
    assert len(rig.audience.snapshots) == 2
    both = rig.audience.snapshots[1]
    assert both.stamp_ns == 1
    np.testing.assert_array_equal(
        both.surface.position, shown.surface.position.astype(np.float32), strict=False
    )
    np.testing.assert_array_equal(both.force.force, shown.force.force.astype(np.float32))
    assert np.isnan(both.latency_s)  # of wrenches, and there was none


def test_rate_and_latency_are_those_of_the_wrenches(rig, ros, snapshots):
    rig.look()
    surfaces = ros.publisher(Surface, "surface")
    wrenches = ros.publisher(WrenchStamped, "wrench")
    now_ns = time.time_ns()
    for number in range(11):
        wrenches.publish(WrenchStamped(header=header_at(now_ns - 10**9 + number * 10**7)))
    surfaces.publish(surface_to_msg(snapshots[0].surface, header_at(1)))
    ros.wait(lambda: rig.audience.snapshots, "the surface")
    shown = rig.audience.snapshots[0]
    assert shown.rate_hz == pytest.approx(100.0)
    assert 0.9 <= shown.latency_s < 60.0


def test_an_image_that_comes_later_than_the_force_is_shown_with_its_grid(rig, ros, snapshots):
    """An image is large: it is shown with the next surface, never a grid on another image."""
    rig.look()
    grids = ros.publisher(Grid, "left/grid")
    surfaces = ros.publisher(Surface, "surface")
    images = ros.publisher(Image, "image_raw")
    shown = snapshots[-1]
    images.publish(image_to_msg(snapshots[0].frame, "mono8", header_at(7)))
    grids.publish(grid_to_msg(shown.left, header_at(8)))
    surfaces.publish(surface_to_msg(shown.surface, header_at(8)))
    ros.wait(lambda: rig.audience.snapshots, "the surface")
    images.publish(image_to_msg(shown.frame, "mono8", header_at(8)))
    ros.run(0.2)
    surfaces.publish(surface_to_msg(shown.surface, header_at(9)))
    ros.wait(lambda: rig.audience.snapshots[-1].stamp_ns == 9, "the next surface")
    first, last = rig.audience.snapshots[0], rig.audience.snapshots[-1]
    assert not first.has_image
    np.testing.assert_array_equal(last.frame, shown.frame)
    np.testing.assert_array_equal(last.left.corner_status, shown.left.corner_status)


def test_a_message_that_cannot_be_used_is_reported(rig, ros, snapshots):
    rig.look()
    publisher = ros.publisher(Surface, "surface")
    message = surface_to_msg(snapshots[-1].surface, header_at(1))
    message.rows += 1
    publisher.publish(message)
    line = rig.says("expected")
    assert (line.severity, line.about) == (Severity.WARNING, f"{ros.namespace}/surface")
    assert rig.audience.snapshots[-1].surface is None


def test_a_silent_topic_is_named(rig, ros):
    """The first of the chain on which nothing comes: the others wait for it."""
    rig.look()
    rig.says(f"waiting for {ros.namespace}/image_raw: nothing published; is the sensor running?")
    ros.node.create_publisher(Image, "image_raw", 1)
    rig.says(f"waiting for {ros.namespace}/image_raw: it has a publisher, but no message comes")


def test_diagnostics_of_other_sensors_are_left_out(rig, ros):
    rig.look()
    publisher = ros.publisher(DiagnosticArray, "/diagnostics")
    place = ros.namespace.lstrip("/")
    statuses = (
        (DiagnosticStatus.ERROR, f"{place}/camera", "no frame for 2 s: check the cable"),
        (DiagnosticStatus.OK, f"{place}/surface", ""),
        (DiagnosticStatus.ERROR, "elsewhere/camera", "of another robot"),
    )
    publisher.publish(
        DiagnosticArray(
            status=[
                DiagnosticStatus(level=level, name=name, message=text)
                for level, name, text in statuses
            ]
        )
    )
    line = rig.says("no frame for 2 s: check the cable")
    assert (line.severity, line.about) == (Severity.ERROR, f"{ros.namespace}/camera")
    assert rig.says("1 reports without problems").severity is Severity.OK
    assert not any("another robot" in line.text for line in rig.audience.health)


def test_zero_calls_the_service_and_says_its_answer(rig, ros):
    answers = [(True, "force counts from now on"), (False, "no frame yet")]

    def answer(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = answers.pop(0)
        return response

    ros.node.create_service(Trigger, "stereo_triangulator/set_reference", answer)
    assert rig.do(rig.action["zero"]) == "force counts from now on"
    refused = rig.do(rig.action["zero"])
    assert isinstance(refused, CmpTactileError)
    assert str(refused) == "no frame yet"


def test_parameters_are_those_of_the_nodes(rig, ros, monkeypatch):
    monkeypatch.setattr(controls, "STAGES", ("stereo_triangulator",))
    node = ros.start(StereoTriangulator, sensor_description=rig.description)
    found = rig.do(lambda: controls.node_settings(ros.node, ros.namespace, views=()))
    settings = {item.name: item for item in found}
    assert {item.owner for item in found} == {"stereo_triangulator"}
    frames = settings["reference_frames"]
    assert (frames.value, frames.low, frames.high) == (10, 1, 1000)
    assert frames.description == "number of frames that a reference averages"
    assert not any("diagnostics" in name for name in settings)
    assert "sensor_description" not in settings  # cannot change
    assert rig.do(lambda: frames.change(20.0)) == "is now 20"
    assert node.get_parameter("reference_frames").value == 20
    assert isinstance(rig.do(lambda: frames.change(0)), CmpTactileError)
    assert node.get_parameter("reference_frames").value == 20


def test_a_recording_has_what_came_while_it_ran(rig, ros, snapshots, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    press = rig.action["record"]
    assert rig.do(press).startswith(f"into {tmp_path}/thumb_")
    publisher = ros.publisher(Image, "image_raw")
    frame = snapshots[0].frame
    for number in range(3):
        publisher.publish(image_to_msg(frame, "mono8", header_at(10**9 + number)))
        ros.run(0.1)
    said = rig.do(press)
    (bag,) = tmp_path.iterdir()
    assert said.startswith(f"{bag}: 3 messages")
    images = [item.image for item in BagReader(bag).frames()]
    assert len(images) == 3
    np.testing.assert_array_equal(images[0], frame)


def test_gel_and_held_object_move_as_tf_says(ros, grasp_bag, snapshots):
    """Below a gripper that moves; what is not finite is left out, and a late marker is shown."""
    rig = Rig(ros, str(grasp_bag / "sensor.yaml"), scene_frame="world")
    rig.look()
    surfaces = ros.publisher(Surface, "surface")
    static = StaticTransformBroadcaster(ros.node)
    moving = ros.publisher(TFMessage, "/tf")
    shown = rig.audience.snapshots

    def show(stamp_ns: int, lift: float) -> Snapshot:
        moving.publish(transforms(stamp_ns, ("world", "gripper", lift), ("world", "object", 0.03)))
        ros.run(0.1)
        surfaces.publish(surface_to_msg(snapshots[0].surface, header_at(stamp_ns)))
        ros.wait(lambda: shown and shown[-1].stamp_ns == stamp_ns, "the surface")
        return shown[-1]

    assert show(1, 0.0).mount is None
    fixed = transforms(0, ("gripper", "thumb_gel_frame", 0.01))
    static.sendTransform(fixed.transforms)
    ros.run(0.1)
    first = show(2, 0.1)
    assert first.mount.position == pytest.approx((0.0, 0.0, 0.11))
    assert first.body is None
    triangles = np.eye(3)[None]
    latched = ros.node.create_publisher(Marker, "/object/marker", latched_qos())
    latched.publish(ROS_MESSAGES.triangles(triangles, (1, 2, 3), header_at(0, "object")))
    ros.run(0.2)
    second = show(3, np.nan)
    assert second.mount.position == pytest.approx((0.0, 0.0, 0.11))
    assert second.body.pose.position == pytest.approx((0.0, 0.0, 0.03))
    np.testing.assert_array_equal(second.body.triangles, triangles)
    rig.live.pause()
    ros.wait(lambda: not ros.node.count_subscribers("/tf"), "the end of its subscriptions")


def transforms(stamp_ns: int, *items: tuple[str, str, float]) -> Any:
    """A TFMessage of parents, children and heights."""
    return TFMessage(
        transforms=[
            ROS_MESSAGES.transform(
                header_at(stamp_ns, parent), child, np.array([0, 0, z]), Rotation.identity()
            )
            for parent, child, z in items
        ]
    )


def test_a_drag_is_a_target_for_the_indenter(rig, ros):
    rig.look()
    targets = ros.listen(PoseStamped, "indenter/target")
    poses = ros.publisher(PoseStamped, "indenter/pose")
    touch = rig.live.touches()["thumb"]
    assert touch.pose is None
    here = PoseStamped()
    here.pose.position.z = 0.002
    poses.publish(here)
    ros.wait(lambda: touch.pose, "the indenter's pose")
    assert touch.pose.position == (0.0, 0.0, 0.002)
    ros.wait(lambda: ros.node.count_subscribers(f"{ros.namespace}/indenter/target"), "a listener")
    touch.move(Pose((0.001, -0.002, -0.0005), (0.0, 0.0, 0.0, 1.0)))
    ros.wait(lambda: targets, "the target")
    place, turn = targets[0].pose.position, targets[0].pose.orientation
    assert (place.x, place.y, place.z) == (0.001, -0.002, -0.0005)
    assert (turn.w, turn.z) == (0.0, 1.0)
    assert targets[0].header.frame_id == "thumb_gel_frame"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"sensors": "/a /b"}, "parameter sensor_descriptions: found 1, expected 2"),
        ({"sensor_names": "a b"}, "parameter sensor_names: found 2, expected 1"),
        ({"mounts": "0 0 0"}, "parameter mounts: found '0 0 0', expected six numbers"),
    ],
)
def test_parameters_that_do_not_fit(given, message):
    with pytest.raises(InputError, match=message):
        running_sensors(WebViewerParameters(**given), "/rig")


def test_two_sensors_stand_at_their_mounting_poses():
    given = WebViewerParameters(
        sensors="/rig/left /rig/right",
        sensor_descriptions="sample_rig:sample_rig",
        sensor_names="left right",
        mounts=f"0 0 0 0 0 0, 0 0.05 0 {np.pi} 0 0",
    )
    left, right = running_sensors(given, "")
    assert (left.namespace, right.namespace) == ("/rig/left", "/rig/right")
    assert (left.shown.name, right.shown.name) == ("left", "right")
    assert left.shown.mount.orientation == (1.0, 0.0, 0.0, 0.0)
    assert right.shown.mount.position == (0.0, 0.05, 0.0)
    assert right.shown.mount.orientation == pytest.approx((0.0, 1.0, 0.0, 0.0), abs=1e-12)


def test_from_topic_to_browser(ros, grasp_bag, snapshots, opened):
    """The whole way, and back: a surface moves the mesh, a click reaches the service."""
    node = ros.start(WebViewer, sensor_descriptions=str(grasp_bag / "sensor.yaml"))
    reports = ros.reports("web_viewer")
    called = []

    def answer(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        called.append(True)
        return Trigger.Response(success=True, message="zeroed")

    ros.node.create_service(Trigger, "stereo_triangulator/set_reference", answer)
    tab = opened(node.page)
    publisher = ros.publisher(Surface, "surface")
    for number, shown in enumerate((snapshots[0], snapshots[-1])):
        publisher.publish(surface_to_msg(shown.surface, header_at(number)))
        expected = 1e3 * np.nanmax(shown.surface.position[..., 2])
        ros.wait(lambda z=expected: abs(tab.meshes()[1] - z) < 0.05, "the surface")
    tab.tab.get_by_text("zero", exact=True).click()
    ros.wait(lambda: called, "the call of the service")
    ros.wait(lambda: tab.tab.get_by_text("zeroed").count(), "its answer")
    ros.wait(lambda: reports.last.message == "1 browsers show the page", "its report")
