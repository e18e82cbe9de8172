"""Several sensors of one description: their frames begin with names of their own."""

from __future__ import annotations

import cv2
import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from sensor_msgs.msg import CameraInfo, Image
from tf2_msgs.msg import TFMessage

from cmp_tactile_driver.nodes.camera_driver import CameraDriver
from cmp_tactile_driver.nodes.replay import Replay
from cmp_tactile_processing.nodes.view_splitter import ViewSplitter

FRAME = "left_finger_camera_optical_frame"


@pytest.fixture
def images(ros):
    return ros.listen(Image, "image_raw")


@pytest.fixture
def infos(ros):
    return ros.listen(CameraInfo, "camera_info")


def _frames_of(messages):
    return {message.header.frame_id for message in messages}


def test_a_replay_gives_recorded_frames_and_camera_infos_its_sensors_name(
    ros, frame_bag, images, infos
):
    ros.start(Replay, input=str(frame_bag), sensor_name="left_finger", wait_for_subscribers=1)
    ros.wait(lambda: images and infos, "frames and camera infos")
    assert _frames_of(images) == _frames_of(infos) == {FRAME}
    assert list(infos[0].d) == [0.1, 0.2, 0.3, 0.4, 0.5]


def test_a_camera_gives_its_frames_its_sensors_name(ros, tmp_path, bags, images, infos):
    cv2.imwrite(str(tmp_path / "0.png"), bags.frames(1, 768, 1024)[0])
    ros.start(CameraDriver, input=str(tmp_path), sensor_name="left_finger", loop=True)
    ros.wait(lambda: images and infos, "frames and camera infos")
    assert _frames_of(images) == _frames_of(infos) == {FRAME}


def test_two_splitters_of_one_description_share_no_tf_frame(ros):
    statics = ros.listen(TFMessage, "/tf_static", latched=True)
    for name in ("left_finger", "right_finger"):
        ros.start(ViewSplitter, name=name, sensor_name=name)
    ros.wait(lambda: len(statics) >= 2, "both trees")
    trees = {item.header.frame_id: set() for message in statics for item in message.transforms}
    for message in statics:
        for item in message.transforms:
            trees[item.header.frame_id].add(item.child_frame_id)
    assert set(trees) == {"left_finger_gel_frame", "right_finger_gel_frame"}
    for parent, children in trees.items():
        prefix = parent.removesuffix("gel_frame")
        assert children == {f"{prefix}{eye}_optical_frame" for eye in ("camera", "left", "right")}
