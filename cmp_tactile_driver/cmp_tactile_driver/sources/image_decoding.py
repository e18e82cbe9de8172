"""Pixels from image files and from the fields of ROS image messages, without ROS."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.errors import ImageDecodingError
from cmp_tactile_processing.errors import FrameError, found_text
from cmp_tactile_processing.image import compressed as compressed_image

__all__ = ["ENCODINGS", "decode_compressed", "decode_file", "decode_raw"]

MAX_SIDE = 16384
CHANNELS = {
    "mono8": 1,
    "8UC1": 1,
    "bgr8": 3,
    "8UC3": 3,
    "rgb8": 3,
    "yuv422_yuy2": 2,
    "yuyv": 2,
}
ENCODINGS = tuple(CHANNELS)
"""What `decode_raw` takes, by the names of sensor_msgs/image_encodings.h."""


def decode_file(path: Path) -> NDArray[np.uint8]:
    """The image of a file: (H, W) where it is grey, otherwise (H, W, 3) BGR, uint8.

    Raises ImageDecodingError naming the file.
    """
    try:
        content = np.fromfile(path, np.uint8)
    except OSError as error:
        msg = f"{path}: cannot be read: {error.strerror}"
        raise ImageDecodingError(msg) from None
    try:
        return compressed_image.decode_image(content, str(path))
    except FrameError as error:
        raise ImageDecodingError(str(error)) from None


def decode_compressed(format_text: str, data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image of a sensor_msgs/CompressedImage: (H, W) or (H, W, 3) BGR, uint8.

    Raises ImageDecodingError for anything but png and jpeg, and for data that are no such image.
    """
    try:
        return compressed_image.decode_compressed(format_text, data)
    except FrameError as error:
        raise ImageDecodingError(str(error)) from None


def decode_raw(
    size: tuple[int, int], encoding: str, step: int, data: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """The image of a sensor_msgs/Image: (H, W) for mono8, otherwise (H, W, 3) BGR, uint8.

    size: width, height in px.  step: bytes per row.  data: (N,) uint8; not copied for mono8.
    Raises ImageDecodingError naming the field.
    """
    width, height = size
    if encoding not in CHANNELS:
        msg = f"encoding: found {found_text(encoding)}, expected one of {', '.join(ENCODINGS)}"
        raise ImageDecodingError(msg)
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        msg = f"width, height: found {width} x {height}, expected 1 to {MAX_SIDE}"
        raise ImageDecodingError(msg)
    channels = CHANNELS[encoding]
    if step < width * channels:
        msg = f"step: found {step} bytes, expected at least {width * channels} for {encoding}"
        raise ImageDecodingError(msg)
    if data.size != height * step:
        msg = f"data: found {data.size} bytes, expected {height * step} (height x step)"
        raise ImageDecodingError(msg)
    rows = data.reshape(height, step)[:, : width * channels]
    return _to_grey_or_bgr(rows, width, encoding)


def _to_grey_or_bgr(rows: NDArray[np.uint8], width: int, encoding: str) -> NDArray[np.uint8]:
    channels = CHANNELS[encoding]
    if channels == 1:
        return np.ascontiguousarray(rows)
    pixels = np.ascontiguousarray(rows).reshape(len(rows), width, channels)
    if encoding in ("bgr8", "8UC3"):
        return pixels
    if encoding != "rgb8" and width % 2:
        msg = f"width: found {width} px, expected an even number for {encoding}"
        raise ImageDecodingError(msg)
    code = cv2.COLOR_RGB2BGR if encoding == "rgb8" else cv2.COLOR_YUV2BGR_YUY2
    return np.asarray(cv2.cvtColor(pixels, code), np.uint8)
