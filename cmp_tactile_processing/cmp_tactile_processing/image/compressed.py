"""Pixels of a compressed camera frame: PNG and JPEG, as image_transport names them; image files."""

from __future__ import annotations

import re

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from cmp_tactile_processing.errors import FrameError, found_text
from cmp_tactile_processing.image.raw import MAX_SIDE, BitDepth, demosaiced

START_OF_IMAGE = b"\xff\xd8"
START_OF_SCAN = 0xDA
# What libjpeg says of bytes between the segments of a header, which some cameras put there; those
# before RST0 to RST7 (0xd0) and the end of the image (0xd9) are pixels that could not be decoded.
HEADER_FILLER = re.compile(r"extraneous bytes before marker 0x(?!d\d)")


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
        msg = f"{origin}: found {content.size} bytes that are no readable image"
        raise FrameError(msg)
    if image.dtype == np.uint16:
        image = (depth or BitDepth(origin)).to_8_bits(np.asarray(image, np.uint16))
    if image.dtype != np.uint8:
        msg = f"{origin}: found {image.dtype} pixels, expected uint8 or uint16"
        raise FrameError(msg)
    if image.ndim == 3 and image.shape[2] == 4:
        image = cv2.cvtColor(image, cv2.COLOR_BGRA2BGR)
    return np.asarray(image, np.uint8)


def decode_jpeg(
    content: bytes,
    origin: str,
    *,
    size: tuple[int, int] | None = None,
    grey: bool = False,
) -> NDArray[np.uint8]:
    """The image of a JPEG: (H, W), or (H, W, 3) BGR where it has colours and not `grey`, uint8.

    size: width and height that it must have, px.  Read by libjpeg-turbo as OpenCV does, which
    keeps libjpeg's warnings for itself and fills up what is missing.
    Raises FrameError, which begins with `origin`, also where libjpeg only warns.
    """
    try:
        height, width, space, _ = simplejpeg.decode_jpeg_header(content, strict=False)
    except (ValueError, KeyError) as error:  # KeyError: a sampling of colours that is none
        msg = f"{origin}: found {len(content)} bytes that are no readable image: {error}"
        raise FrameError(msg) from None
    expected = size or (min(width, MAX_SIDE), min(height, MAX_SIDE))
    if (width, height) != expected:
        msg = f"{origin}: found {width} x {height} px, expected {expected[0]} x {expected[1]} px"
        raise FrameError(msg)
    target = "CMYK" if space in ("CMYK", "YCCK") else "GRAY" if grey or space == "Gray" else "BGR"
    try:
        image = _decode_strictly(content, target)
    except ValueError as error:
        msg = f"{origin}: found a damaged JPEG of {len(content)} bytes ({error})"
        raise FrameError(msg) from None
    if target == "CMYK":
        flags = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR
        flags |= cv2.IMREAD_IGNORE_ORIENTATION
        return np.asarray(cv2.imdecode(np.frombuffer(content, np.uint8), flags), np.uint8)
    return image[..., 0] if target == "GRAY" else image


def _decode_strictly(content: bytes, target: str) -> NDArray[np.uint8]:
    try:
        return np.asarray(simplejpeg.decode_jpeg(content, target, strict=True), np.uint8)
    except ValueError as error:
        if not HEADER_FILLER.search(str(error)):
            raise
        # libjpeg reports its first warning only: there may be one of the pixels behind it.
        content = _without_filler(content)
        return np.asarray(simplejpeg.decode_jpeg(content, target, strict=True), np.uint8)


def _without_filler(content: bytes) -> bytes:
    """A JPEG without the bytes between the segments of its header (ITU-T T.81, B.1.1.2)."""
    parts, at = [START_OF_IMAGE], content.find(b"\xff", 2)
    while 0 <= at < len(content) - 4 and content[at + 1] != START_OF_SCAN:
        after = at + 2 + int.from_bytes(content[at + 2 : at + 4], "big")
        if content[at + 1] in (0x00, 0xFF):  # no marker, or fills up
            after = at + 1
        else:
            parts.append(content[at:after])
        at = content.find(b"\xff", after)
    return b"".join([*parts, content[at:]])
