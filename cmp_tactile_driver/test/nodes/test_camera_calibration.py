"""camera_info of the camera driver: from the description, from a file, and by set_camera_info."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import CameraInfo
from sensor_msgs.srv import SetCameraInfo
from std_msgs.msg import Header

from cmp_tactile_driver.nodes.camera_calibration import camera_info_of, camera_info_path
from cmp_tactile_driver.nodes.camera_driver import CameraDriver
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.rectification import (
    ViewCameraInfo,
    read_camera_info,
    write_camera_info,
)
from cmp_tactile_processing.sensor.description import load_sensor

SERVICE = "set_camera_info"


@pytest.fixture
def folder(tmp_path):
    """Images of the sample rig's size."""
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((768, 1024), np.uint8))
    return tmp_path


@pytest.fixture
def described():
    """The sample rig's own camera_info."""
    return camera_info_of(load_sensor("sample_rig"), Header())


def _model(message):
    return ViewCameraInfo(
        width=message.width,
        height=message.height,
        model=message.distortion_model,
        D=np.array(message.d),
        K=np.array(message.k).reshape(3, 3),
        R=np.array(message.r).reshape(3, 3),
        P=np.array(message.p).reshape(3, 4),
    )


def _start(ros, folder, url="", **parameters):
    given = {"input": str(folder), "loop": True, "frame_rate": 50.0, "camera_info_url": url}
    return ros.start(CameraDriver, **{**given, **parameters})


def test_a_calibration_that_is_set_is_published_kept_and_read_again(ros, folder, described):
    path = folder / "made" / "sample_rig.yaml"
    url = f"file://{folder}/made/${{NAME}}.yaml"
    infos = ros.listen(CameraInfo, "camera_info")
    reports = ros.reports("camera_driver")
    node = _start(ros, folder, url)
    ros.wait(lambda: infos, "a camera_info")
    assert list(infos[0].k) == list(described.k)
    ros.wait(lambda: "found no file" in reports.last.message, "the report of it")
    described.d = [0.0004, 0.0, 0.0, 0.0, 0.0]
    answer = ros.call(SetCameraInfo, SERVICE, SetCameraInfo.Request(camera_info=described))
    assert answer.success, answer.status_message
    assert answer.status_message == f"stored in {path}"
    ros.wait(lambda: infos[-1].d[0] == 0.0004, "the new one on the topic")
    assert infos[-1].header.frame_id == "sample_rig_camera_optical_frame"
    name, kept = read_camera_info(path)
    assert (name, kept.D[0]) == ("sample_rig", 0.0004)
    ros.executor.remove_node(node)
    node.destroy_node()
    infos.clear()
    _start(ros, folder, url)
    ros.wait(lambda: infos, "a camera_info of the second node")
    assert infos[-1].d[0] == 0.0004
    ros.wait(lambda: reports.last.level == DiagnosticStatus.OK, "the report of the second node")


def test_another_lens_is_published_and_reported(ros, folder, described):
    path = folder / "camera.yaml"
    described.k[0] += 20.0
    write_camera_info(path, "other", _model(described))
    infos = ros.listen(CameraInfo, "camera_info")
    reports = ros.reports("camera_driver")
    _start(ros, folder, f"file://{path}")
    ros.wait(lambda: reports.last.level == DiagnosticStatus.WARN, "the report of it")
    assert f"{path}: K: found [753.386" in reports.last.message
    assert "the processing uses the sensor description" in reports.last.message
    assert infos[-1].k[0] == described.k[0]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"width": 640}, "image_width: found 640, expected 1024 as in"),
        ({"distortion_model": "fisheye"}, "distortion_model: found 'fisheye'"),
        ({"d": [0.0]}, "distortion_coefficients"),
        ({"k": np.zeros(9)}, "camera_matrix"),
    ],
)
def test_a_calibration_that_cannot_be_used_changes_nothing(ros, folder, described, changes, text):
    path = folder / "camera.yaml"
    infos = ros.listen(CameraInfo, "camera_info")
    _start(ros, folder, f"file://{path}")
    before = list(described.k)
    for field, value in changes.items():
        setattr(described, field, value)
    answer = ros.call(SetCameraInfo, SERVICE, SetCameraInfo.Request(camera_info=described))
    assert not answer.success
    assert text in answer.status_message
    assert not path.exists()
    infos.clear()
    ros.wait(lambda: infos, "a camera_info")
    assert (infos[-1].width, list(infos[-1].k)) == (1024, before)


def test_without_a_place_to_keep_it_a_calibration_is_refused(ros, folder, described):
    _start(ros, folder)
    answer = ros.call(SetCameraInfo, SERVICE, SetCameraInfo.Request(camera_info=described))
    assert not answer.success
    assert "camera_info_url: found nothing, expected" in answer.status_message


def test_a_file_that_cannot_be_used_ends_the_start(ros, folder, described):
    path = folder / "camera.yaml"
    write_camera_info(path, "other", replace(_model(described), height=480))
    with pytest.raises(InputError, match="image_height: found 480, expected 768"):
        _start(ros, folder, f"file://{path}")
    path.write_text("image_width: 3\n")
    with pytest.raises(InputError, match=r"camera\.yaml"):
        _start(ros, folder, f"file://{path}")


def test_urls(monkeypatch, tmp_path):
    monkeypatch.setenv("ROS_HOME", str(tmp_path))
    assert camera_info_path("", "rig") is None
    kept = camera_info_path("file://${ROS_HOME}/camera_info/${NAME}.yaml", "rig")
    assert kept == tmp_path / "camera_info" / "rig.yaml"
    assert camera_info_path("file:///a%20b.yaml", "rig").name == "a b.yaml"
    in_package = camera_info_path("package://cmp_tactile_driver/cameras/a.yaml", "rig")
    assert in_package.parts[-4:] == ("share", "cmp_tactile_driver", "cameras", "a.yaml")
    with pytest.raises(InputError, match="found no package 'nowhere'"):
        camera_info_path("package://nowhere/a.yaml", "rig")
    for url in ("/a.yaml", "file://a.yaml", "http://host/a.yaml", "package://cmp_tactile_driver"):
        with pytest.raises(InputError, match=r"found '.*', expected file://PATH or package://"):
            camera_info_path(url, "rig")
