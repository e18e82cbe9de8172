"""Stand-in for cv_bridge, for machines without that package: on the decoder of this suite."""

from __future__ import annotations

import array
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.image.encodings import MAX_BITS, BitDepth, convert_raw, raw_pixels

__all__ = ["CvBridge", "CvBridgeError"]


class CvBridgeError(TypeError):
    """A message or an image that cannot be converted."""


class CvBridge:
    """Images of messages, and messages of images."""

    def imgmsg_to_cv2(self, img_msg: Any, desired_encoding: str = "passthrough") -> NDArray[Any]:
        """The pixels (H, W) or (H, W, channels), as they were sent, or as "mono8" or "bgr8".

        Raises CvBridgeError for any other encoding, or a buffer that is too small.
        """
        encoding, data = img_msg.encoding, np.frombuffer(img_msg.data, np.uint8)
        size, big_endian = (img_msg.width, img_msg.height), bool(img_msg.is_bigendian)
        try:
            pixels = raw_pixels(size, encoding, img_msg.step, data, big_endian=big_endian)
        except FrameError as error:
            raise CvBridgeError(str(error)) from None
        if desired_encoding in ("passthrough", encoding):
            return pixels
        if desired_encoding not in ("mono8", "bgr8"):
            raise CvBridgeError(f"found {desired_encoding!r}, expected mono8 or bgr8")
        to_grey, depth = desired_encoding == "mono8", BitDepth()
        depth.bits = MAX_BITS
        image = convert_raw(pixels, encoding, luminance=to_grey, depth=depth)
        if (image.ndim == 2) == to_grey:
            return image
        return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY if to_grey else cv2.COLOR_GRAY2BGR)

    def cv2_to_imgmsg(self, cvim: NDArray[Any], encoding: str, header: Any = None) -> Any:
        """The message of pixels (H, W) or (H, W, channels) of 8 or 16 bits."""
        row = np.ascontiguousarray(cvim).view(np.uint8).reshape(len(cvim), -1)
        message = Image(height=len(cvim), width=cvim.shape[1], encoding=encoding, step=row.shape[1])
        message.data = array.array("B", row.tobytes())
        if header is not None:
            message.header = header
        return message
