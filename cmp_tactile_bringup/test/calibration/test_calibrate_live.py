"""Calibration from topics, through real DDS."""

import itertools
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np
import pytest
from command_output import run
from waiting import in_background

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from cmp_tactile_bringup.calibration.live import LiveFrames
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.ros.messages.conversions import image_to_msg
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.sensor.parts import ImageSize

# Finding a publisher takes DDS up to a few seconds on a busy machine.
TIMEOUT_S = 60.0
SAMPLE_RIG = load_sensor("sample_rig")
SMALL = replace(SAMPLE_RIG, image=ImageSize(16, 12))


@contextmanager
def publishing(ros, images, interval_s=0.02):
    """The topic on which the images come, one after another."""
    publisher = ros.node.create_publisher(Image, "camera/image_raw", 2)
    messages = (image_to_msg(image, "mono8", Header()) for image in images)
    with in_background(map(publisher.publish, messages), interval_s):
        yield f"{ros.namespace}/camera/image_raw"


@pytest.fixture
def camera(ros):
    """A topic with the same small image again and again."""
    with publishing(ros, itertools.repeat(np.full((12, 16), 7, np.uint8))) as topic:
        yield topic


def images_of(folder):
    """The images of a folder, in order."""
    return [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(folder.glob("*.png"))]


@pytest.mark.parametrize("named", ["camera/image_raw", "camera/image_raw/compressed"])
def test_compressed_frames_are_taken_where_there_are_only_these(ros, named):
    """By their own name, and by that of the images that they are made of.

    Reports: ros-visualization/rqt_image_view 69 (the type is chosen before there is a publisher),
    ros-perception/image_pipeline 417 (only CompressedImage is published); tried: frames come.
    """
    grey = np.full((12, 16), 7, np.uint8)
    png = CompressedImage(format="mono8; png compressed ")
    png.data.frombytes(cv2.imencode(".png", grey)[1].tobytes())
    publisher = ros.node.create_publisher(CompressedImage, "camera/image_raw/compressed", 2)
    with (
        in_background(map(publisher.publish, itertools.repeat(png)), 0.02),
        LiveFrames(f"{ros.namespace}/{named}", SMALL, TIMEOUT_S) as live,
    ):
        np.testing.assert_array_equal(next(iter(live)), grey)


def test_a_topic_of_another_type_is_named_with_it(ros):
    publisher = ros.node.create_publisher(Header, "camera/image_raw", 2)

    def complaint() -> str:
        with (
            LiveFrames(f"{ros.namespace}/camera/image_raw", SMALL, 2.0) as live,
            pytest.raises(FrameSourceError) as raised,
        ):
            next(iter(live))
        return str(raised.value)

    # On a busy machine 2 s may be too short to discover it.
    assert any("found std_msgs/msg/Header, expected sens" in complaint() for _ in range(20))
    ros.node.destroy_publisher(publisher)


def test_frames_of_another_size_end_the_reading(camera):
    with (
        LiveFrames(camera, SAMPLE_RIG, TIMEOUT_S) as live,
        pytest.raises(FrameSourceError, match=r"found frames of 16 x 12.*expected 1024 x 768"),
    ):
        next(iter(live))


def test_a_topic_that_nobody_publishes_names_those_that_there_are(camera):
    with LiveFrames(camera, SMALL, TIMEOUT_S) as live:
        next(iter(live))  # so that the camera is known to this process

    def complaint() -> str:
        expected = pytest.raises(FrameSourceError, match="/nobody/image_raw: no frame within 2 s")
        with LiveFrames("/nobody/image_raw", SMALL, 2.0) as live, expected as raised:
            next(iter(live))
        return str(raised.value)

    # On a busy machine 2 s may be too short to discover it.
    assert any(camera in complaint() for _ in range(20))


def test_a_board_is_taken_from_a_topic_where_it_is_held_still(ros, practice_set, tmp_path, capsys):
    shown = images_of(practice_set / "board")[:3]
    frames = tmp_path / "new_calibration" / "frames"

    def held():
        """Each board until an image of it is kept, as a person holds it; between them, none."""
        for count, board in enumerate(shown):
            yield np.zeros_like(board)
            for _ in range(600):
                if (frames / f"{count:03d}.png").exists():
                    break
                yield board

    with publishing(ros, held(), 0.1) as topic:
        live = ("--topic", topic, "--timeout", TIMEOUT_S, "--images", 3)
        board = ("--board", "9x6", "--square", 0.0011, "--sensor", practice_set / "sensor.yaml")
        code = run("calibrate", "board", *live, *board, "--output", tmp_path / "new.yaml")
    # Three images are too few, and it says so; they are kept for another try.
    assert code == 1
    assert "what to do" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["new_calibration"]
    kept = images_of(frames)
    np.testing.assert_array_equal(kept, shown)
