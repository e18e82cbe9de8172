"""Stand-in for cv_bridge, for machines without that package: on the decoder of this suite."""

from __future__ import annotations

import array
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.image.encodings import raw_pixels

__all__ = ["CvBridge", "CvBridgeError"]


class CvBridgeError(TypeError):
    """A message or an image that cannot be converted."""


class CvBridge:
    """Images of messages, and messages of images."""

    def imgmsg_to_cv2(self, img_msg: Any, desired_encoding: str = "passthrough") -> NDArray[Any]:
        """The pixels (H, W) or (H, W, channels) as they were sent.

        Raises CvBridgeError for an encoding that is not known or another one that is desired, and
        for a buffer that is too small.
        """
        encoding, data = img_msg.encoding, np.frombuffer(img_msg.data, np.uint8)
        size, big_endian = (img_msg.width, img_msg.height), bool(img_msg.is_bigendian)
        if desired_encoding not in ("passthrough", encoding):
            raise CvBridgeError(f"found {desired_encoding!r}, expected 'passthrough'")
        try:
            return raw_pixels(size, encoding, img_msg.step, data, big_endian=big_endian)
        except FrameError as error:
            raise CvBridgeError(str(error)) from None

    def cv2_to_imgmsg(self, cvim: NDArray[Any], encoding: str, header: Any = None) -> Any:
        """The message of pixels (H, W) or (H, W, channels) of 8 or 16 bits."""
        row = np.ascontiguousarray(cvim).view(np.uint8).reshape(len(cvim), -1)
        message = Image(height=len(cvim), width=cvim.shape[1], encoding=encoding, step=row.shape[1])
        message.data = array.array("B", row.tobytes())
        if header is not None:
            message.header = header
        return message
