"""Calibration from topics, through real DDS."""

from __future__ import annotations

import threading

import numpy as np
import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from sensor_msgs.msg import Image
from std_msgs.msg import Header

from cmp_tactile_bringup.live_frames import LiveFrames
from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_processing.nodes.images import image_to_msg

# Finding a publisher takes DDS up to a few seconds on a busy machine.
TIMEOUT_S = 20.0


@pytest.fixture
def camera(ros):
    """Publishes the same small image on `camera/image_raw` of the test's namespace."""
    publisher = ros.node.create_publisher(Image, "camera/image_raw", 2)
    message = image_to_msg(np.full((12, 16), 7, np.uint8), "mono8", Header())
    ended = threading.Event()

    def publish():
        while not ended.wait(0.02):
            publisher.publish(message)

    thread = threading.Thread(target=publish)
    thread.start()
    yield f"{ros.namespace}/camera/image_raw"
    ended.set()
    thread.join()


def test_frames_come_from_a_topic(camera):
    with LiveFrames(camera, (16, 12), TIMEOUT_S) as live:
        frames = iter(live)
        for _ in range(3):
            np.testing.assert_array_equal(next(frames), np.full((12, 16), 7))


def test_frames_of_another_size_end_the_reading(camera):
    with (
        LiveFrames(camera, (1024, 768), TIMEOUT_S) as live,
        pytest.raises(FrameSourceError, match=r"found frames of 16 x 12.*expected 1024 x 768"),
    ):
        next(iter(live))


def test_a_topic_that_nobody_publishes_names_those_that_there_are(camera):
    with LiveFrames(camera, None, TIMEOUT_S) as live:
        next(iter(live))  # so that the camera is known to this process
    with (
        LiveFrames("/nobody/image_raw", None, 2.0) as live,
        pytest.raises(FrameSourceError, match="/nobody/image_raw: no frame within 2 s") as told,
    ):
        next(iter(live))
    assert camera in str(told.value)
