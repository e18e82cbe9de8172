"""Pixels of a camera frame from its encoding: raw, PNG and JPEG; image files.

Compressed frames are named as image_transport names them.  A JPEG is judged as strictly as libjpeg
can, and read as cameras send it.
"""

from __future__ import annotations

import logging
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from cmp_tactile_processing.errors import FrameError, found_text

LOGGER = logging.getLogger(__name__)
MAX_SIDE = 16384
MAX_BITS = 16
START_OF_IMAGE = b"\xff\xd8"
IMAGE_STARTS = (START_OF_IMAGE, b"\x89PNG")
END_OF_IMAGE = b"\xff\xd9"
START_OF_SCAN = 0xDA
# The version of a TIFF with 64-bit offsets, and the tag of how to turn it for viewing.
BIG_TIFF, ORIENTATION = 43, 274
# A byte 0xff of the pixels (0x00 follows each) is never the last of a picture in colour. Two bytes
# 0x00 can be: two blocks without colour.
FILL = re.compile(rb"(?:\xff\x00)+(?=\xff+[\xd0-\xd7\xd9])|(?<=\x00\x00)\x00+(?=\xff+\xd9)")

# OpenCV names a mosaic by its second row, ROS by its first.
BAYER = {
    "rggb": (cv2.COLOR_BayerBG2BGR, cv2.COLOR_BayerBG2GRAY),
    "bggr": (cv2.COLOR_BayerRG2BGR, cv2.COLOR_BayerRG2GRAY),
    "gbrg": (cv2.COLOR_BayerGR2BGR, cv2.COLOR_BayerGR2GRAY),
    "grbg": (cv2.COLOR_BayerGB2BGR, cv2.COLOR_BayerGB2GRAY),
}
# What image_transport adds to the topic of an image.
COMPRESSED = "/compressed"


class BitDepth:
    """How many of their 16 bits the pixels of a stream use; 8 bits are made of these.

    bits: 8, 10, 12, 14 or 16; 0 until a frame with 16 bits a pixel has come.  It never becomes
    less, so that grey values do not jump where a frame is darker.
    """

    def __init__(
        self,
        name: str = "image",
        say: Callable[[str], object] = LOGGER.warning,
        look_ahead: Callable[[], int] | None = None,
    ) -> None:
        """name: of the stream, for `say`, which is called when `bits` changes.

        look_ahead: gives the bits that the frames to come use; called once, at the first frame
        with 16 bits a pixel.
        """
        self.bits = 0
        self._name, self._say, self._look_ahead = name, say, look_ahead

    def to_8_bits(self, pixels: NDArray[np.uint16]) -> NDArray[np.uint8]:
        """Pixels of any shape, from 0 to 255 over the bits that are used."""
        bits = max(self.bits, used_bits(pixels))
        if self._look_ahead is not None:
            look_ahead, self._look_ahead = self._look_ahead, None
            bits = max(bits, look_ahead())
        if bits > self.bits:
            before = f" instead of {self.bits}" if self.bits else ""
            self.bits = bits
            self._say(f"{self._name}: pixels use {bits} of 16 bits{before}: scaled to 8 bits")
        return np.asarray(cv2.convertScaleAbs(pixels, alpha=255 / (2**bits - 1)), np.uint8)


def used_bits(pixels: NDArray[np.uint16]) -> int:
    """The least of 8, 10, 12, 14 and 16 bits that hold all pixels."""
    length = int(pixels.max(initial=0)).bit_length()
    return max(8, length + length % 2)


@dataclass(frozen=True)
class PixelLayout:
    """How an encoding lays out pixels.

    samples: per pixel, in the first plane.  deep: samples of 16 bits.  planes: height of all
    planes in that of the image.  to_bgr, to_grey: OpenCV's conversions; None where it needs none.
    luma: which sample is the luminance; None where none is.
    """

    samples: int = 1
    to_bgr: int | None = None
    to_grey: int | None = None
    deep: bool = False
    planes: float = 1.0
    luma: int | None = None

    @property
    def pixel_bytes(self) -> int:
        """Of a pixel in a row."""
        return self.samples * (2 if self.deep else 1)


YUYV = PixelLayout(2, cv2.COLOR_YUV2BGR_YUY2, luma=0)


UYVY = PixelLayout(2, cv2.COLOR_YUV2BGR_UYVY, luma=1)


ENCODINGS: dict[str, PixelLayout] = {
    "mono8": PixelLayout(),
    "8UC1": PixelLayout(),
    "bgr8": PixelLayout(3),
    "8UC3": PixelLayout(3),
    "rgb8": PixelLayout(3, cv2.COLOR_RGB2BGR),
    "bgra8": PixelLayout(4, cv2.COLOR_BGRA2BGR),
    "8UC4": PixelLayout(4, cv2.COLOR_BGRA2BGR),
    "rgba8": PixelLayout(4, cv2.COLOR_RGBA2BGR),
    "mono16": PixelLayout(deep=True),
    "16UC1": PixelLayout(deep=True),
    "bgr16": PixelLayout(3, deep=True),
    "16UC3": PixelLayout(3, deep=True),
    "rgb16": PixelLayout(3, cv2.COLOR_RGB2BGR, deep=True),
    "bgra16": PixelLayout(4, cv2.COLOR_BGRA2BGR, deep=True),
    "16UC4": PixelLayout(4, cv2.COLOR_BGRA2BGR, deep=True),
    "rgba16": PixelLayout(4, cv2.COLOR_RGBA2BGR, deep=True),
    "yuyv": YUYV,
    "yuv422_yuy2": YUYV,
    "uyvy": UYVY,
    "yuv422": UYVY,
    "nv12": PixelLayout(1, cv2.COLOR_YUV2BGR_NV12, planes=1.5, luma=0),
    "nv21": PixelLayout(1, cv2.COLOR_YUV2BGR_NV21, planes=1.5, luma=0),
    "nv24": PixelLayout(1, cv2.COLOR_YUV2BGR_NV12, planes=3.0, luma=0),
} | {
    f"bayer_{order}{bits}": PixelLayout(1, *codes, deep=bits == MAX_BITS)
    for order, codes in BAYER.items()
    for bits in (8, MAX_BITS)
}


"""What `decode_raw` takes: all that cv_bridge makes mono8 of, and 8UC*, 16UC* and nv12."""


def decode_raw(  # noqa: PLR0913  the fields of a message
    size: tuple[int, int],
    encoding: str,
    step: int,
    data: NDArray[np.uint8],
    *,
    big_endian: bool = False,
    luminance: bool = False,
    depth: BitDepth | None = None,
) -> NDArray[np.uint8]:
    """The image of a sensor_msgs/Image: (H, W) where it is grey, otherwise (H, W, 3) BGR, uint8.

    size: width, height in px.  step: bytes per row.  data: (N,) uint8; not copied where it need
    not be changed; what is beyond the image is left out.  big_endian: of samples of 16 bits.
    luminance: read YUV and Bayer as grey.  depth: of the stream; absent for an image by itself.
    Raises FrameError as `raw_pixels`.
    """
    pixels = raw_pixels(size, encoding, step, data, big_endian=big_endian)
    return convert_raw(pixels, encoding, luminance=luminance, depth=depth)


def raw_pixels(
    size: tuple[int, int], encoding: str, step: int, data: NDArray[np.uint8], *, big_endian: bool
) -> NDArray[Any]:
    """(H, W) or (H, W, samples) uint8 or uint16 as they were sent; all planes, one below another.

    Arguments as of `decode_raw`.
    Raises FrameError naming the field, for an encoding that is not in ENCODINGS or a buffer that
    does not fit size and step.
    """
    width, height = size
    layout = check_raw(size, encoding, step, data.size)
    lines = round(height * layout.planes)
    if layout.planes > 1 and data.size < lines * step:
        step = min(step, width)
    rows = data[: lines * step].reshape(lines, step)[:, : width * layout.pixel_bytes]
    pixels = np.ascontiguousarray(rows)
    if layout.deep:
        kind = np.dtype(">u2" if big_endian else "<u2")
        pixels = pixels.view(kind).astype(np.uint16, copy=False)
    return pixels if layout.samples == 1 else pixels.reshape(height, width, layout.samples)


def convert_raw(
    pixels: NDArray[Any], encoding: str, *, luminance: bool, depth: BitDepth | None
) -> NDArray[np.uint8]:
    """The image, as of `decode_raw`, of pixels as of `raw_pixels`."""
    layout = ENCODINGS[encoding]
    height = round(len(pixels) / layout.planes)
    if layout.deep:
        if layout.samples == 4:
            pixels = pixels.copy()
            pixels[..., 3] = 0  # alpha, which uses all 16 bits
        pixels = (depth or BitDepth()).to_8_bits(pixels)
    if layout.luma is not None and luminance:
        # The luminance as the camera measured it.
        luma = pixels[:height] if layout.samples == 1 else pixels[..., layout.luma]
        return np.ascontiguousarray(luma)
    if encoding == "nv24":
        pixels = _nv12_of_nv24(pixels, pixels.shape[1], height)
    code = layout.to_grey if luminance and layout.to_grey is not None else layout.to_bgr
    return pixels if code is None else np.asarray(cv2.cvtColor(pixels, code), np.uint8)


def demosaiced(mosaic: NDArray[np.uint8], encoding: str) -> NDArray[np.uint8]:
    """BGR (H, W, 3) of the samples (H, W) of an encoding bayer_*; as it is for any other."""
    layout = ENCODINGS.get(encoding)
    if layout is None or layout.to_grey is None or mosaic.ndim != 2:
        return mosaic
    return np.asarray(cv2.cvtColor(mosaic, layout.to_bgr or 0), np.uint8)


def _nv12_of_nv24(lines: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """(1.5 H, W) of (3 H, W): one chroma of four, as OpenCV converts it."""
    chroma = lines[height:].reshape(height, width, 2)[::2, ::2]
    return np.concatenate([lines[:height], chroma.reshape(-1, width)])


def check_raw(size: tuple[int, int], encoding: str, step: int, length: int) -> PixelLayout:
    """The layout of an image of `length` bytes; raises FrameError as `raw_pixels`."""
    layout = ENCODINGS.get(encoding)
    if layout is None:
        msg = (
            f"encoding: found {found_text(encoding)}, expected mono8, bgr8, mono16, bayer_rggb8, "
            "yuyv or another one that docs/conventions.md lists"
        )
        raise FrameError(msg)
    width, height = size
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        msg = f"width, height: found {width} x {height}, expected 1 to {MAX_SIDE}"
        raise FrameError(msg)
    if layout.luma is not None and width % 2:
        msg = f"width: found {width} px, expected an even number for {encoding}"
        raise FrameError(msg)
    if layout.planes > 1 and height % 2:
        msg = f"height: found {height} px, expected an even number for {encoding}"
        raise FrameError(msg)
    lines = round(height * layout.planes)
    if layout.planes > 1 and length < lines * step:
        step = min(step, width)  # some drivers count the samples of all planes in a row
    if step < width * layout.pixel_bytes:
        least = width * layout.pixel_bytes
        msg = f"step: found {step} bytes, expected at least {least} for {encoding}"
        raise FrameError(msg)
    if length < lines * step:
        msg = f"data: found {length} bytes, expected {lines * step} ({lines} rows of {step})"
        raise FrameError(msg)
    return layout


def decode_jpeg(
    content: bytes,
    origin: str,
    *,
    size: tuple[int, int] | None = None,
    grey: bool = False,
) -> NDArray[np.uint8]:
    """The image of a JPEG: (H, W), or (H, W, 3) BGR where it has colours and not `grey`, uint8.

    size: width and height that it must have, px.  Read by libjpeg-turbo as OpenCV does, which
    keeps libjpeg's warnings for itself and fills up what is missing.  What loses no pixel is read:
    bytes that fill up before a marker, a missing end of the image, missing Huffman tables (libjpeg
    takes those of ITU-T T.81, K.3).
    Raises FrameError, which begins with `origin`, also where libjpeg only warns.
    """
    try:
        height, width, space, _ = simplejpeg.decode_jpeg_header(content, strict=False)
    except (ValueError, KeyError) as error:  # KeyError: a sampling of colours that is none
        msg = f"{origin}: found {len(content)} bytes that are not a readable image: {error}"
        raise FrameError(msg) from None
    expected = size or (min(width, MAX_SIDE), min(height, MAX_SIDE))
    if (width, height) != expected:
        msg = f"{origin}: found {width} x {height} px, expected {expected[0]} x {expected[1]} px"
        raise FrameError(msg)
    target = "CMYK" if space in ("CMYK", "YCCK") else "GRAY" if grey or space == "Gray" else "BGR"
    try:
        image = simplejpeg.decode_jpeg(content, target, strict=True)
    except ValueError:
        try:
            image = simplejpeg.decode_jpeg(_without_fill(content), target, strict=True)
        except ValueError as error:
            msg = f"{origin}: found a damaged JPEG of {len(content)} bytes ({error})"
            raise FrameError(msg) from None
    if target == "CMYK":
        flags = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR
        flags |= cv2.IMREAD_IGNORE_ORIENTATION
        return np.asarray(cv2.imdecode(np.frombuffer(content, np.uint8), flags), np.uint8)
    return np.asarray(image[..., 0] if target == "GRAY" else image, np.uint8)


def _without_fill(content: bytes) -> bytes:
    """The JPEG with its end, and without the bytes that fill up.

    These are any bytes between segments of the header (ITU-T T.81, B.1.1.2), a byte 0xff at the end
    of pixels (Logitech's cameras), and 0x00 before the end of the image.
    """
    segments, at = [START_OF_IMAGE], content.find(b"\xff", 2)
    while 0 <= at < len(content) - 4 and content[at + 1] != START_OF_SCAN:
        after = at + 2 + int.from_bytes(content[at + 2 : at + 4], "big")
        if content[at + 1] in (0x00, 0xFF):  # no marker, or fills up
            after = at + 1
        else:
            segments.append(content[at:after])
        at = content.find(b"\xff", after)
    return b"".join([*segments, FILL.sub(b"", content[at:] + END_OF_IMAGE)])


def decode_compressed(
    format_text: str, data: NDArray[np.uint8], depth: BitDepth | None = None
) -> NDArray[np.uint8]:
    """The image of a sensor_msgs/CompressedImage: (H, W) or (H, W, 3) BGR, uint8.

    format_text: its field `format`, such as "mono8; png compressed ", "rgb8; jpeg compressed bgr8"
    or "jpeg".  data: (N,).  depth: of the stream; absent for an image by itself.
    Where it names no image, the first bytes of the data do.
    Raises FrameError for anything but png and jpeg, and for data that are no such image.
    """
    text = format_text.lower()
    is_image = any(kind in text for kind in ("png", "jpeg", "jpg"))
    if "compresseddepth" in text or not (is_image or data[:8].tobytes().startswith(IMAGE_STARTS)):
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
        image = cv2.imdecode(not_turned(content), cv2.IMREAD_UNCHANGED) if content.size else None
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


def not_turned(content: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A TIFF with orientation 1 in place of what its images have; the bytes (N,) of other files.

    OpenCV turns and mirrors those images whatever its flags are, but no PNG, WebP or JPEG.
    """
    order = {b"II": "<", b"MM": ">"}.get(content[:2].tobytes())
    if order is None:
        return content
    data = bytearray(content.tobytes())
    try:
        is_big = struct.unpack_from(f"{order}H", data, 2)[0] == BIG_TIFF
        count, offset, entry_bytes = ("Q", "Q", 20) if is_big else ("H", "I", 12)
        next_at, seen = (8 if is_big else 4), set[int]()
        while (begin := struct.unpack_from(order + offset, data, next_at)[0]) not in {0, *seen}:
            seen.add(begin)
            entries = struct.unpack_from(order + count, data, begin)[0]
            first = begin + struct.calcsize(count)
            next_at = first + entries * entry_bytes
            for at in range(first, next_at, entry_bytes):
                if struct.unpack_from(f"{order}H", data, at)[0] == ORIENTATION:
                    struct.pack_into(
                        f"{order}H", data, at + entry_bytes - struct.calcsize(offset), 1
                    )
    except struct.error:
        return content  # is cut off
    return np.frombuffer(data, np.uint8)
