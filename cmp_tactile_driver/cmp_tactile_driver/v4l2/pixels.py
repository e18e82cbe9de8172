"""Pixels from the buffer of a camera."""

from __future__ import annotations

import struct

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.errors import ImageDecodingError
from cmp_tactile_driver.sources.frames import ImageSize, size_text
from cmp_tactile_driver.sources.image_decoding import decode_raw
from cmp_tactile_driver.v4l2.modes import Mode

__all__ = ["decode_buffer"]

RAW_ENCODINGS = {"GREY": "mono8", "YUYV": "yuyv", "BGR3": "bgr8", "RGB3": "rgb8"}
START_OF_IMAGE, END_OF_IMAGE = b"\xff\xd8", b"\xff\xd9"
# ITU-T T.81, table B.1: SOF0 to SOF15, without the three tables and extensions among them.
FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
START_OF_SCAN = 0xDA


def decode_buffer(
    data: bytes, mode: Mode, bytes_per_line: int, *, colour: bool
) -> NDArray[np.uint8]:
    """(H, W) uint8 grey, or with `colour`, and where the camera has it, (H, W, 3) BGR.

    Raises ImageDecodingError for a buffer that is cut off or no such image.
    """
    pixels = np.frombuffer(data, np.uint8)
    encoding = RAW_ENCODINGS.get(mode.pixel_format)
    if encoding is None:
        image = _decode_jpeg(data, mode.size, colour=colour)
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


def _decode_jpeg(data: bytes, size: ImageSize, *, colour: bool) -> NDArray[np.uint8]:
    # OpenCV fills up what is missing of a JPEG, and says so on stderr only.
    if END_OF_IMAGE not in data:
        msg = f"data: found {len(data)} bytes without the end of a JPEG, expected a whole one"
        raise ImageDecodingError(msg)
    # The decoder takes memory for whatever size the header names.
    _check_size(_jpeg_size(data), size, len(data))
    try:
        flags = cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    # Turned, where the header says so.
    _check_size(None if image is None else (image.shape[1], image.shape[0]), size, len(data))
    return np.asarray(image, np.uint8)


def _check_size(found: ImageSize | None, expected: ImageSize, length: int) -> None:
    if found is None:
        msg = f"data: found {length} bytes that are no readable image, expected a JPEG"
        raise ImageDecodingError(msg)
    if found != expected:
        msg = f"data: found {size_text(found)}, expected {size_text(expected)}"
        raise ImageDecodingError(msg)


def _jpeg_size(data: bytes) -> ImageSize | None:
    """Width and height in the frame header (ITU-T T.81, B.2.2); None where there is none.

    As in libjpeg, bytes between two segments are passed over.
    """
    at = data.find(b"\xff", 2) if data.startswith(START_OF_IMAGE) else -1
    while 0 <= at <= len(data) - 9:
        marker = data[at + 1]
        if marker in FRAME_HEADERS:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        if marker == START_OF_SCAN:
            return None
        if marker == 0xFF:  # fills up
            after = at + 1
        elif marker in (0x00, 0x01) or 0xD0 <= marker <= 0xD9:  # stand alone
            after = at + 2
        else:
            after = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        at = data.find(b"\xff", after)
    return None
