"""Pixels from the buffer of a camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.errors import ImageDecodingError
from cmp_tactile_driver.frame_source import ImageSize, size_text
from cmp_tactile_driver.image_decoding import decode_compressed, decode_raw

__all__ = ["decode_buffer"]

RAW_ENCODINGS = {"GREY": "mono8", "YUYV": "yuyv", "BGR3": "bgr8", "RGB3": "rgb8"}
END_OF_IMAGE = b"\xff\xd9"


def decode_buffer(
    data: bytes, pixel_format: str, size: ImageSize, bytes_per_line: int
) -> NDArray[np.uint8]:
    """(H, W) uint8 where the camera gives grey, otherwise (H, W, 3) BGR.

    pixel_format: four characters, one of v4l2_modes.PREFERENCE.
    Raises ImageDecodingError for a buffer that is cut off or no such image.
    """
    pixels = np.frombuffer(data, np.uint8)
    if pixel_format in RAW_ENCODINGS:
        return decode_raw(size, RAW_ENCODINGS[pixel_format], bytes_per_line, pixels)
    # OpenCV fills up what is missing of a JPEG, and says so on stderr only.
    if END_OF_IMAGE not in data:
        msg = f"data: found {len(data)} bytes without the end of a JPEG image, expected a whole one"
        raise ImageDecodingError(msg)
    image = decode_compressed("jpeg", pixels)
    found = (image.shape[1], image.shape[0])
    if found != size:
        msg = f"data: found {size_text(found)}, expected {size_text(size)}"
        raise ImageDecodingError(msg)
    return image
