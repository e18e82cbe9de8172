"""Image messages from arrays and back."""

from __future__ import annotations

import numpy as np
from cv_bridge import CvBridge, CvBridgeError
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.split import to_grey

__all__ = ["ENCODINGS", "grey_from_msg", "image_to_msg"]

# Encodings that are read, with their bytes per pixel.
ENCODINGS = {"mono8": 1, "bgr8": 3, "rgb8": 3, "yuv422_yuy2": 2}

_bridge = CvBridge()


def grey_from_msg(msg: Image) -> NDArray[np.uint8]:
    """Grey image (H, W) uint8 of a message.

    Raises FrameError, naming the field, for an encoding that is not in ENCODINGS or a buffer that
    does not fit width, height and step.
    """
    _check(msg)
    native = msg.encoding in ("mono8", "bgr8")
    try:
        image = _bridge.imgmsg_to_cv2(msg, "passthrough" if native else "mono8")
    except CvBridgeError as error:
        text = f"encoding: found {msg.encoding!r}, which cannot be converted to grey: {error}"
        raise FrameError(text) from None
    return to_grey(image)


def image_to_msg(image: NDArray[np.uint8], encoding: str, header: Header) -> Image:
    """The message of an image, "mono8" (H, W) or "bgr8" (H, W, 3)."""
    msg: Image = _bridge.cv2_to_imgmsg(image, encoding)
    msg.header = header
    return msg


def _check(msg: Image) -> None:
    if msg.encoding not in ENCODINGS:
        text = f"encoding: found {msg.encoding!r}, expected one of {', '.join(ENCODINGS)}"
        raise FrameError(text)
    if not msg.width or not msg.height:
        text = f"width, height: found {msg.width} x {msg.height}, expected an image"
        raise FrameError(text)
    if msg.step < msg.width * ENCODINGS[msg.encoding]:
        expected = msg.width * ENCODINGS[msg.encoding]
        text = f"step: found {msg.step} bytes, expected at least {expected}"
        raise FrameError(text)
    if len(msg.data) != msg.height * msg.step:
        expected = msg.height * msg.step
        text = f"data: found {len(msg.data)} bytes, expected {expected} (height x step)"
        raise FrameError(text)
