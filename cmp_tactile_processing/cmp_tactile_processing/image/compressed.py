"""Pixels of a compressed camera frame: PNG and JPEG, as image_transport names them; image files."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import FrameError, found_text
from cmp_tactile_processing.image.jpeg import START_OF_IMAGE, decode_jpeg
from cmp_tactile_processing.image.raw import BitDepth, demosaiced

# What image_transport adds to the topic of an image.
COMPRESSED = "/compressed"


def decode_compressed(
    format_text: str, data: NDArray[np.uint8], depth: BitDepth | None = None
) -> NDArray[np.uint8]:
    """The image of a sensor_msgs/CompressedImage: (H, W) or (H, W, 3) BGR, uint8.

    format_text: its field `format`, such as "mono8; png compressed ", "rgb8; jpeg compressed bgr8"
    or "jpeg".  data: (N,).  depth: of the stream; absent for an image by itself.
    Raises FrameError for anything but png and jpeg, and for data that are no such image.
    """
    text = format_text.lower()
    if "compresseddepth" in text or not any(kind in text for kind in ("png", "jpeg", "jpg")):
        msg = f"format: found {found_text(format_text)}, expected png or jpeg"
        raise FrameError(msg)
    image = demosaiced(decode_image(data, "data", depth), text.partition(";")[0].strip())
    if image.ndim == 3 and "compressed rgb" in text:
        return np.ascontiguousarray(image[..., ::-1])
    return image


def decode_image(
    content: NDArray[np.uint8], origin: str, depth: BitDepth | None = None
) -> NDArray[np.uint8]:
    """The image of the bytes (N,) of an image file: (H, W) or (H, W, 3) BGR, uint8.

    depth: of the stream that the image is from; absent for an image by itself.
    Raises FrameError, which begins with `origin`, also for a JPEG that is damaged.
    """
    if content[:2].tobytes() == START_OF_IMAGE:
        return decode_jpeg(content.tobytes(), origin)
    try:
        image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if content.size else None
    except cv2.error:  # a size beyond OpenCV's limit
        image = None
    if image is None:
        msg = f"{origin}: found {content.size} bytes that are not a readable image"
        raise FrameError(msg)
    if image.dtype not in (np.uint8, np.uint16):
        msg = f"{origin}: found {image.dtype} pixels, expected uint8 or uint16"
        raise FrameError(msg)
    if image.ndim == 3 and image.shape[2] == 4:
        # First: alpha uses all 16 bits.
        image = cv2.cvtColor(image, cv2.COLOR_BGRA2BGR)
    if image.dtype == np.uint16:
        image = (depth or BitDepth(origin)).to_8_bits(np.asarray(image, np.uint16))
    return np.asarray(image, np.uint8)
