"""Pixels of a compressed camera frame: PNG and JPEG, as image_transport names them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import FrameError, found_text


def decode_compressed(format_text: str, data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image of a sensor_msgs/CompressedImage: (H, W) or (H, W, 3) BGR, uint8.

    format_text: its field `format`, such as "mono8; png compressed " or "jpeg".  data: (N,).
    Raises FrameError for anything but png and jpeg, and for data that are no such image.
    """
    text = format_text.lower()
    if "compresseddepth" in text or not any(kind in text for kind in ("png", "jpeg", "jpg")):
        msg = f"format: found {found_text(format_text)}, expected png or jpeg"
        raise FrameError(msg)
    return decode_image(data, "data")


def decode_image(content: NDArray[np.uint8], origin: str) -> NDArray[np.uint8]:
    """The image of the bytes (N,) of an image file: (H, W) or (H, W, 3) BGR, uint8.

    Raises FrameError, which begins with `origin`.
    """
    try:
        image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if content.size else None
    except cv2.error:  # a size beyond OpenCV's limit
        image = None
    if image is None:
        msg = f"{origin}: found {content.size} bytes that are no readable image"
        raise FrameError(msg)
    if image.dtype != np.uint8:
        msg = f"{origin}: found {image.dtype} pixels, expected uint8"
        raise FrameError(msg)
    if image.ndim == 3 and image.shape[2] == 4:
        image = cv2.cvtColor(image, cv2.COLOR_BGRA2BGR)
    return np.asarray(image, np.uint8)
