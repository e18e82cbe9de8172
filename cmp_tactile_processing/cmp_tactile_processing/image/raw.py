"""Pixels of a raw camera frame, in the encodings of sensor_msgs/image_encodings.hpp."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import FrameError, found_text

LOGGER = logging.getLogger(__name__)
MAX_SIDE = 16384
MAX_BITS = 16


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
# OpenCV names a mosaic by its second row, ROS by its first.
BAYER = {
    "rggb": (cv2.COLOR_BayerBG2BGR, cv2.COLOR_BayerBG2GRAY),
    "bggr": (cv2.COLOR_BayerRG2BGR, cv2.COLOR_BayerRG2GRAY),
    "gbrg": (cv2.COLOR_BayerGR2BGR, cv2.COLOR_BayerGR2GRAY),
    "grbg": (cv2.COLOR_BayerGB2BGR, cv2.COLOR_BayerGB2GRAY),
}
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
    Raises FrameError naming the field, for an encoding that is not in ENCODINGS or a buffer that
    does not fit size and step.
    """
    width, height = size
    layout = _layout(encoding, size)
    lines = round(height * layout.planes)
    if layout.planes > 1 and data.size < lines * step:
        step = min(step, width)  # some drivers count the samples of all planes in a row
    _check_buffer(encoding, step, data, width * layout.pixel_bytes, lines)
    rows = data[: lines * step].reshape(lines, step)[:, : width * layout.pixel_bytes]
    if layout.deep:
        kind = np.dtype(">u2" if big_endian else "<u2")
        deep = np.ascontiguousarray(rows).view(kind).astype(np.uint16, copy=False)
        if layout.samples == 4:
            deep = deep.copy()
            deep[:, 3::4] = 0  # alpha, which uses all 16 bits
        rows = (depth or BitDepth()).to_8_bits(deep)
    if layout.luma is not None and luminance:
        # The luminance as the camera measured it.
        return np.ascontiguousarray(rows[:height, layout.luma :: layout.samples])
    pixels = np.ascontiguousarray(rows)
    if layout.samples > 1:
        pixels = pixels.reshape(height, width, layout.samples)
    if encoding == "nv24":
        pixels = _nv12_of_nv24(pixels, width, height)
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


def _layout(encoding: str, size: tuple[int, int]) -> PixelLayout:
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
    return layout


def _check_buffer(
    encoding: str, step: int, data: NDArray[np.uint8], least: int, lines: int
) -> None:
    if step < least:
        msg = f"step: found {step} bytes, expected at least {least} for {encoding}"
        raise FrameError(msg)
    if data.size < lines * step:
        msg = f"data: found {data.size} bytes, expected {lines * step} ({lines} rows of {step})"
        raise FrameError(msg)
