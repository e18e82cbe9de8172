"""The splitter's images, calibration and tf agree with the sample frames' truth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time
from rcl_interfaces.msg import Log
from rclpy.qos import qos_profile_sensor_data
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.rectification import Rectification
from cmp_tactile_processing.nodes.view_splitter import ViewSplitter
from cmp_tactile_processing.ros.messages.conversions import image_to_msg
from cmp_tactile_processing.sensor.description import load_sensor

pytestmark = pytest.mark.ros

STAMP = Time(sec=12, nanosec=345)
# The truth obeys its projection to 1e-12 px; what is left is rounding of the description.
ATOL_PROJECTION_PX = 1e-6


def _frame_msg(frame: np.ndarray, encoding: str = "mono8") -> Image:
    return image_to_msg(frame, encoding, Header(stamp=STAMP, frame_id="camera"))


def _matrix(transform) -> np.ndarray:
    T = np.eye(4)
    q, t = transform.transform.rotation, transform.transform.translation
    T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = t.x, t.y, t.z
    return T


def _truth_view(sample, view: str) -> np.ndarray:
    """Corners in the view as published: mirrored back within its half of 512 columns."""
    q = sample.truth[f"corners_{view}_px"].copy()
    q[..., 0] = (511 if view == "left" else 1023) - q[..., 0]
    return q


@pytest.fixture
def splitter(ros):
    return ros.start(ViewSplitter)


@pytest.fixture
def described(ros, splitter, sample):
    """The static transforms by frame and the camera_info of each view, after a frame."""
    statics = ros.listen(TFMessage, "/tf_static", latched=True)
    infos = {view: ros.listen(CameraInfo, f"{view}/camera_info") for view in ("left", "right")}
    ros.publisher(Image, "image_raw").publish(_frame_msg(sample("press").frame))
    ros.wait(lambda: statics and all(infos.values()), "tf and camera info")
    return {item.child_frame_id: item for item in statics[0].transforms}, infos


def test_views_are_the_halves_of_a_compressed_frame_and_others_are_reported(ros, sample):
    splitter = ros.start(ViewSplitter, input_transport="compressed")
    frame = sample("slide").frame
    left, right = ros.listen(Image, "left/image_raw"), ros.listen(Image, "right/image_raw")
    publisher = ros.publisher(CompressedImage, "image_raw/compressed")
    header = Header(stamp=STAMP, frame_id="camera")
    png = CompressedImage(header=header, format="mono8; png compressed ")
    png.data.frombytes(cv2.imencode(".png", frame)[1].tobytes())
    broken = CompressedImage(header=header, format="jpeg", data=[1, 2, 3])
    depth = CompressedImage(header=header, format="16UC1; compressedDepth png", data=png.data)
    for message in (broken, depth, png):
        publisher.publish(message)
    ros.wait(lambda: left and right, "both views")
    for name, (view,), columns in (
        ("left", left, frame[:, :512]),
        ("right", right, frame[:, 512:]),
    ):
        assert view.header == Header(stamp=STAMP, frame_id=f"sample_rig_{name}_optical_frame")
        image = np.frombuffer(view.data, np.uint8).reshape(768, 512)
        np.testing.assert_array_equal(image, columns[:, ::-1])
    assert splitter.diagnostics.bad_frames == 2
    assert "format: found '16UC1; compressedDepth png'" in splitter.diagnostics.last_error
    assert "/image_raw/compressed" in splitter.diagnostics.last_error


def test_tf_and_camera_info_project_the_true_points(described, sample):
    """Gel point -> static tf of a view -> R backwards -> K is the pixel of the truth.

    So frames, handedness, centre and the sense of R are right.
    """
    press = sample("press")
    transforms, infos = described
    assert set(transforms) == {
        f"sample_rig_{name}_optical_frame" for name in ("camera", "left", "right")
    }
    points = press.truth["corners_m"].reshape(-1, 3)
    for view, (info,) in infos.items():
        transform = transforms[f"sample_rig_{view}_optical_frame"]
        assert transform.header.frame_id == "sample_rig_gel_frame"
        T_gel_view = _matrix(transform)
        p_view = (points - T_gel_view[:3, 3]) @ T_gel_view[:3, :3] @ info.r.reshape(3, 3)
        assert info.distortion_model == "plumb_bob"
        assert not any(info.d)
        q = p_view @ info.k.reshape(3, 3).T
        truth = _truth_view(press, view).reshape(-1, 2)
        np.testing.assert_allclose(q[:, :2] / q[:, 2:], truth, atol=ATOL_PROJECTION_PX)


MOUNT = {
    "parent_frame": "left_finger_tip",
    "mount_position": [0.01, -0.02, 0.03],
    "mount_orientation": [0.4, -0.3, 2.0],
}


def test_mounting_is_a_urdf_origin_of_the_gel_frame(ros):
    """xyz and rpy: about fixed axes, roll first.  Latched, with the sensor's other frames.

    All frames begin with the name of the sensor: two of one description share none.
    """
    ros.start(ViewSplitter, sensor_name="thumb", **MOUNT)
    statics = ros.listen(TFMessage, "/tf_static", latched=True)
    ros.wait(lambda: statics, "static tf")
    transforms = {item.child_frame_id: item for item in statics[0].transforms}
    optical = [f"thumb_{eye}_optical_frame" for eye in ("camera", "left", "right")]
    assert sorted(transforms) == [optical[0], "thumb_gel_frame", *optical[1:]]
    assert {transforms[eye].header.frame_id for eye in optical} == {"thumb_gel_frame"}
    mounted = transforms["thumb_gel_frame"]
    assert mounted.header.frame_id == "left_finger_tip"
    assert mounted.header.stamp.sec > 0
    roll, pitch, yaw = (
        Rotation.from_rotvec(np.eye(3)[axis] * angle).as_matrix()
        for axis, angle in enumerate(MOUNT["mount_orientation"])
    )
    T = _matrix(mounted)
    np.testing.assert_allclose(T[:3, :3], yaw @ pitch @ roll, atol=1e-12)
    np.testing.assert_array_equal(T[:3, 3], MOUNT["mount_position"])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("parent_frame", "/tool0", r"found '/tool0', expected .*not beginning with /"),
        ("parent_frame", "tool 0", r"found 'tool 0', expected .*without blanks"),
        ("parent_frame", "sample_rig_gel_frame", r"none of sample_rig_gel_frame, sample_rig_cam"),
        ("mount_position", [0.1, 0.2], r"found \[0\.1, 0\.2\], expected 3 numbers"),
        ("mount_position", [35.0, 0.0, 0.0], r"expected 3 numbers from -10 to 10 m$"),
        ("mount_position", [0.0, float("nan"), 0.0], r"found \[0\.0, nan, 0\.0\]"),
        ("mount_orientation", [90.0, 0.0, 0.0], r"expected 3 numbers from -6\.28 to 6\.28 rad$"),
        ("mount_orientation", "upright", r"found 'upright', expected"),
    ],
)
def test_mounting_that_cannot_be_meant_is_refused_with_the_reason(ros, name, value, message):
    """Millimetres, degrees, and frames that tf2 does not take or that close a circle."""
    with pytest.raises(InputError, match=rf"view_splitter: parameter {name}: .*{message}"):
        ros.start(ViewSplitter, **(MOUNT | {name: value}))


def test_rectified_pair_follows_image_pipeline(described, sample):
    """Points of the frame that both camera_infos name, projected by P alone, are the truth's.

    A stock node knows no more: a cloud it makes is in that frame, by P.  With a frame of the raw
    camera's axes, or with each view's own, the cloud would be turned in space.
    """
    press = sample("press")
    transforms, infos = described
    T_gel_left = _matrix(transforms["sample_rig_left_optical_frame"])
    expected = Header(stamp=STAMP, frame_id="sample_rig_left_optical_frame")
    assert [info.header for (info,) in infos.values()] == [expected, expected]
    points = press.truth["corners_m"].reshape(-1, 3)
    p_left = (points - T_gel_left[:3, 3]) @ T_gel_left[:3, :3]
    rows = []
    for view, (info,) in infos.items():
        P = info.p.reshape(3, 4)
        q = p_left @ P[:, :3].T + P[:, 3]
        truth = cv2.undistortPoints(
            _truth_view(press, view).reshape(-1, 1, 2),
            info.k.reshape(3, 3),
            np.array(info.d),
            R=info.r.reshape(3, 3),
            P=P,
        )
        np.testing.assert_allclose(q[:, :2] / q[:, 2:], truth[:, 0], atol=ATOL_PROJECTION_PX)
        rows.append(truth[:, 0, 1])
    np.testing.assert_allclose(*rows, atol=ATOL_PROJECTION_PX)


def test_rectified_image_is_made_for_subscribers_only(ros, splitter, sample, count_calls):
    made = count_calls(Rectification, "rectify")
    frame = sample("slide").frame
    raw = ros.listen(Image, "left/image_raw")
    publisher = ros.publisher(Image, "image_raw")
    publisher.publish(_frame_msg(frame))
    ros.wait(lambda: raw, "the left view")
    assert not made
    rect = ros.listen(Image, "left/image_rect")
    ros.wait_subscribed(splitter, "left/image_rect")
    ros.run(0.2)
    assert rect == [], "nothing may come of a frame before the subscription"
    publisher.publish(_frame_msg(frame))
    ros.wait(lambda: rect, "the rectified view")
    image = np.frombuffer(rect[0].data, np.uint8).reshape(768, 512)
    expected = Rectification(load_sensor("sample_rig")).rectify(
        "left", np.ascontiguousarray(frame[:, 511::-1])
    )
    np.testing.assert_array_equal(image, expected)
    assert rect[0].header == raw[0].header, "the left view's own frame is the pair's"


def test_a_best_effort_camera_is_taken_on_request(ros, sample):
    ros.start(ViewSplitter, reliable_input=False)
    left = ros.listen(Image, "left/image_raw")
    publisher = ros.node.create_publisher(Image, "image_raw", qos_profile_sensor_data)
    ros.wait(publisher.get_subscription_count, "the splitter")
    publisher.publish(_frame_msg(sample("rest").frame))
    ros.wait(lambda: left, "the left view")


def test_a_best_effort_camera_is_told_from_none(ros, splitter):
    """Reports: ros-perception/image_pipeline 770 and 828."""
    logs = ros.listen(Log, "/rosout")
    ros.wait(lambda: ros.node.count_publishers("/rosout") > 1, "the splitter's log")
    ros.node.create_publisher(Image, "image_raw", qos_profile_sensor_data)
    ros.wait(lambda: any("reliable_input" in log.msg for log in logs), "the parameter's name")


def test_bad_frames_cost_one_warning_and_no_good_frame(ros, splitter, sample):
    frame = sample("rest").frame
    left = ros.listen(Image, "left/image_raw")
    logs, reports = ros.listen(Log, "/rosout"), ros.reports("view_splitter")
    name = f"{ros.namespace}/view_splitter"[1:]
    truncated, strange = _frame_msg(frame), _frame_msg(frame)
    truncated.data = truncated.data[:1000]
    strange.encoding = "32FC1"
    publisher = ros.publisher(Image, "image_raw")
    ros.wait(lambda: ros.node.count_publishers("/rosout") > 1, "the splitter's log")
    ros.run(0.3)
    for bad in (_frame_msg(frame[:100]), truncated, strange):
        publisher.publish(bad)
    publisher.publish(_frame_msg(frame))
    ros.wait(lambda: left, "the good frame")
    ros.wait(lambda: reports.values.get("frames in") == "4", "diagnostics")
    values = reports.values
    assert (values["frames out"], values["bad frames"]) == ("1", "3")
    topic = f"{ros.namespace}/image_raw"
    assert values["last error"].startswith(f"{topic}: encoding: found '32FC1', expected mono8")
    warnings = [log.msg for log in logs if log.name == name.replace("/", ".") and log.level >= 30]
    assert warnings == [f"{topic}: image: found 1024 x 100 px, expected 1024 x 768 px"]
    assert len(left) == 1
