"""Every encoding comes out as from the real cv_bridge, where that is installed; in itself else."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from cv_bridge import CvBridge, CvBridgeError
from sensor_msgs.msg import Image

from cmp_tactile_processing.image.encodings import ENCODINGS
from cmp_tactile_processing.ros.messages.conversions import image_from_topic, image_to_msg
from cmp_tactile_processing.ros.messages.reading import image_from_msg

pytestmark = pytest.mark.ros
WIDTH, HEIGHT = 16, 12


def message(encoding, padding=0):
    layout = ENCODINGS[encoding]
    step = WIDTH * layout.pixel_bytes + padding
    sent = Image(height=HEIGHT, width=WIDTH, encoding=encoding, step=step)
    rng = np.random.default_rng(3)
    sent.data = rng.integers(0, 256, round(HEIGHT * layout.planes) * step, np.uint8).tobytes()
    return sent


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("weights", [None, (0.299, 0.587, 0.114)])
def test_a_topic_reads_as_a_bag_does(encoding, padding, weights):
    """With the real cv_bridge this compares it to the decoder of the suite, on every encoding."""
    sent = message(encoding, padding)
    found = image_from_topic(sent, weights)
    np.testing.assert_array_equal(found, image_from_msg(sent, weights))


@pytest.mark.parametrize(("encoding", "channels"), [("mono8", 1), ("bgr8", 3), ("mono16", 1)])
def test_there_and_back(encoding, channels):
    kind = np.uint16 if encoding == "mono16" else np.uint8
    shape = (HEIGHT, WIDTH) if channels == 1 else (HEIGHT, WIDTH, channels)
    pixels = np.random.default_rng(4).integers(0, 256, shape).astype(kind)
    sent = image_to_msg(pixels, encoding, Image().header)
    assert (sent.width, sent.height, sent.step) == (WIDTH, HEIGHT, pixels[0].nbytes)
    np.testing.assert_array_equal(CvBridge().imgmsg_to_cv2(sent), pixels)


def test_what_is_no_image_is_refused():
    with pytest.raises(CvBridgeError):
        CvBridge().imgmsg_to_cv2(Image(height=2, width=2, encoding="theora", step=2, data=bytes(4)))
    with pytest.raises(TypeError):
        CvBridge().imgmsg_to_cv2(Image(height=2, width=2, encoding="mono8", step=2, data=bytes(3)))
