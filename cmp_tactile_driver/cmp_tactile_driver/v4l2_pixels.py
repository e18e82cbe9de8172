"""Pixels from the buffer of a camera."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.errors import ImageDecodingError
from cmp_tactile_driver.frame_source import ImageSize, size_text
from cmp_tactile_driver.image_decoding import decode_raw
from cmp_tactile_driver.v4l2_modes import Mode

__all__ = ["decode_buffer"]

RAW_ENCODINGS = {"GREY": "mono8", "YUYV": "yuyv", "BGR3": "bgr8", "RGB3": "rgb8"}
END_OF_IMAGE = b"\xff\xd9"


def decode_buffer(
    data: bytes, mode: Mode, bytes_per_line: int, *, colour: bool
) -> NDArray[np.uint8]:
    """(H, W) uint8 grey, or with `colour`, and where the camera has it, (H, W, 3) BGR.

    Raises ImageDecodingError for a buffer that is cut off or no such image.
    """
    pixels = np.frombuffer(data, np.uint8)
    encoding = RAW_ENCODINGS.get(mode.pixel_format)
    if encoding is None:
        image = _decode_jpeg(pixels, mode.size, colour=colour)
    elif encoding == "yuyv" and not colour:
        # Every second byte is luminance, as the camera measured it.
        image = _luminance(pixels, mode.size, bytes_per_line)
    else:
        image = decode_raw(mode.size, encoding, bytes_per_line, pixels)
    if image.ndim == 3 and not colour:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    return image


def _luminance(
    pixels: NDArray[np.uint8], size: ImageSize, bytes_per_line: int
) -> NDArray[np.uint8]:
    width, height = size
    rows = decode_raw((2 * width, height), "mono8", bytes_per_line, pixels)
    return np.ascontiguousarray(rows[:, ::2])


def _decode_jpeg(pixels: NDArray[np.uint8], size: ImageSize, *, colour: bool) -> NDArray[np.uint8]:
    # OpenCV fills up what is missing of a JPEG, and says so on stderr only.
    if END_OF_IMAGE not in pixels.tobytes():
        msg = f"data: found {pixels.size} bytes without the end of a JPEG, expected a whole one"
        raise ImageDecodingError(msg)
    image = cv2.imdecode(pixels, cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE)
    if image is None:
        msg = f"data: found {pixels.size} bytes that are no readable image, expected a JPEG"
        raise ImageDecodingError(msg)
    found = (image.shape[1], image.shape[0])
    if found != size:
        msg = f"data: found {size_text(found)}, expected {size_text(size)}"
        raise ImageDecodingError(msg)
    return np.asarray(image, np.uint8)
