"""Conversion between Image messages and numpy arrays."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from cv_bridge.encodings import Encoding, convert, encoding_of, encoding_of_array
from cv_bridge.errors import CvBridgeError

PASSTHROUGH = "passthrough"


class CvBridge:
    """Converts images; it has no state."""

    def imgmsg_to_cv2(self, img_msg: Image, desired_encoding: str = PASSTHROUGH) -> NDArray[Any]:
        """The image of a message as an array, in the encoding of the message or another.

        Returns (H, W) for one channel, else (H, W, C), in native byte order. With "passthrough" it
        may share the memory of the message. Raises CvBridgeError for an unknown encoding, a
        message whose sizes contradict each other, and a conversion that does not exist.
        """
        encoding = encoding_of(img_msg.encoding)
        image = _pixels(img_msg, encoding)
        if desired_encoding == PASSTHROUGH:
            return image
        return convert(image, encoding, encoding_of(desired_encoding))

    def cv2_to_imgmsg(
        self, cvim: NDArray[Any], encoding: str = PASSTHROUGH, header: Header | None = None
    ) -> Image:
        """A message with a copy of the image.

        cvim: (H, W) or (H, W, C).  encoding: what the values mean; they are not converted.
        Raises TypeError if cvim is no array, CvBridgeError if its type is not the encoding's.
        """
        if not isinstance(cvim, np.ndarray):
            msg = f"image: found {type(cvim).__name__}, expected a numpy array"
            raise TypeError(msg)
        found = encoding_of_array(cvim)
        if encoding == PASSTHROUGH:
            encoding = found.name
        elif encoding_of(encoding).type_name != found.type_name:
            expected = encoding_of(encoding).type_name
            msg = f"image for encoding {encoding!r}: found {found.type_name}, expected {expected}"
            raise CvBridgeError(msg)
        height, width = cvim.shape[:2]
        message = Image(height=height, width=width, encoding=encoding)
        if header is not None:
            message.header = header
        message.is_bigendian = _is_big_endian(cvim.dtype)
        message.step = width * found.channels * found.dtype.itemsize
        message.data.frombytes(np.ascontiguousarray(cvim).data.cast("B") if cvim.size else b"")
        return message


def _pixels(message: Image, encoding: Encoding) -> NDArray[Any]:
    """The pixels of the message without the padding of its rows."""
    pixel_bytes = encoding.dtype.itemsize * encoding.channels
    row_bytes = message.width * pixel_bytes
    if message.step < row_bytes:
        msg = (
            f"image message: found step {message.step}, expected at least {row_bytes} "
            f"(width {message.width} of {encoding.name})"
        )
        raise CvBridgeError(msg)
    if message.height * message.step != len(message.data):
        msg = (
            f"image message: found {len(message.data)} bytes of data, expected "
            f"{message.height * message.step} (height {message.height} times step {message.step})"
        )
        raise CvBridgeError(msg)
    if not row_bytes * message.height:
        msg = f"image message: found {message.width} x {message.height} pixels, expected some"
        raise CvBridgeError(msg)
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
    dtype = encoding.dtype.newbyteorder(">" if message.is_bigendian else "<")
    values = np.ascontiguousarray(rows[:, :row_bytes]).view(dtype)
    native = np.asarray(values, encoding.dtype)
    if encoding.channels == 1:
        return native
    return native.reshape((message.height, message.width, encoding.channels))


def _is_big_endian(dtype: np.dtype[Any]) -> bool:
    return dtype.byteorder == ">" or (dtype.byteorder == "=" and sys.byteorder == "big")
