"""Image messages from arrays and back."""

from __future__ import annotations

import numpy as np
from cv_bridge import CvBridge, CvBridgeError
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from cmp_tactile_processing.errors import FrameError, found_text
from cmp_tactile_processing.geometry.split import LUMINANCE

__all__ = ["ENCODINGS", "image_from_msg", "image_to_msg"]

# Encodings that are read, with their bytes per pixel.
ENCODINGS = {"mono8": 1, "bgr8": 3, "rgb8": 3, "yuv422_yuy2": 2}

_bridge = CvBridge()


def image_from_msg(
    msg: Image, weights: tuple[float, float, float] = LUMINANCE
) -> NDArray[np.uint8]:
    """Image of a message: grey (H, W) uint8, or BGR (H, W, 3) where it comes in colours.

    weights: of red, green and blue in the grey value that is made of it.  YUYV is read as grey
    where luminance is all that is asked of it, because that is what it holds at full resolution.
    Raises FrameError, naming the field, for an encoding that is not in ENCODINGS or a buffer that
    does not fit width, height and step.
    """
    _check(msg)
    wanted = "passthrough" if msg.encoding in ("mono8", "bgr8") else "bgr8"
    if msg.encoding == "yuv422_yuy2" and weights == LUMINANCE:
        wanted = "mono8"
    try:
        return np.asarray(_bridge.imgmsg_to_cv2(msg, wanted), dtype=np.uint8)
    except CvBridgeError as error:
        text = f"encoding: found {found_text(msg.encoding)}, which cannot be converted: {error}"
        raise FrameError(text) from None


def image_to_msg(image: NDArray[np.uint8], encoding: str, header: Header) -> Image:
    """The message of an image, "mono8" (H, W) or "bgr8" (H, W, 3)."""
    msg: Image = _bridge.cv2_to_imgmsg(image, encoding)
    msg.header = header
    return msg


def _check(msg: Image) -> None:
    if msg.encoding not in ENCODINGS:
        text = f"encoding: found {found_text(msg.encoding)}, expected one of {', '.join(ENCODINGS)}"
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
