"""Image encodings: element type, channels and the colour conversions between them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cv_bridge.errors import CvBridgeError

_DTYPES = {
    "8U": np.uint8,
    "8S": np.int8,
    "16U": np.uint16,
    "16S": np.int16,
    "32S": np.int32,
    "32F": np.float32,
    "64F": np.float64,
}
_NAMES = {np.dtype(dtype): name for name, dtype in _DTYPES.items()}
_GENERIC = re.compile(r"(8U|8S|16U|16S|32S|32F|64F)(?:C([1-9][0-9]*))?")
_MAX_CHANNELS = 512


@dataclass(frozen=True)
class Encoding:
    """What a pixel consists of.

    colour: GRAY, RGB, BGR, RGBA, BGRA or a kind of YUV; empty where the encoding, such as 8UC1,
    says nothing of it.
    """

    name: str
    dtype: np.dtype[Any]
    channels: int
    colour: str = ""

    @property
    def type_name(self) -> str:
        """OpenCV's name of the element type, such as 8UC3."""
        return f"{_NAMES[self.dtype]}C{self.channels}"


_COLOURS = {
    encoding.name: encoding
    for encoding in (
        Encoding("mono8", np.dtype(np.uint8), 1, "GRAY"),
        Encoding("mono16", np.dtype(np.uint16), 1, "GRAY"),
        Encoding("bgr8", np.dtype(np.uint8), 3, "BGR"),
        Encoding("rgb8", np.dtype(np.uint8), 3, "RGB"),
        Encoding("bgra8", np.dtype(np.uint8), 4, "BGRA"),
        Encoding("rgba8", np.dtype(np.uint8), 4, "RGBA"),
        Encoding("yuv422", np.dtype(np.uint8), 2, "YUV_UYVY"),
        Encoding("yuv422_yuy2", np.dtype(np.uint8), 2, "YUV_YUY2"),
    )
}


def encoding_of(name: str) -> Encoding:
    """The encoding of that name. Raises CvBridgeError if it is none of those known here."""
    if name in _COLOURS:
        return _COLOURS[name]
    generic = _GENERIC.fullmatch(name)
    channels = int(generic[2] or 1) if generic else 0
    if generic is None or channels > _MAX_CHANNELS:
        known = ", ".join(_COLOURS)
        msg = f"image encoding: found {name!r}, expected one of {known} or a type such as 8UC1"
        raise CvBridgeError(msg)
    return Encoding(name, np.dtype(_DTYPES[generic[1]]), channels)


def encoding_of_array(image: NDArray[Any]) -> Encoding:
    """The encoding without colour, such as 8UC3, of a (H, W) or (H, W, C) array."""
    name = _NAMES.get(image.dtype.newbyteorder("="))
    if name is None or image.ndim not in (2, 3):
        msg = (
            f"image array: found shape {image.shape} of {image.dtype}, expected (H, W) or "
            f"(H, W, C) of {', '.join(str(dtype) for dtype in _NAMES)}"
        )
        raise CvBridgeError(msg)
    return encoding_of(f"{name}C{1 if image.ndim == 2 else image.shape[2]}")


def convert(image: NDArray[Any], source: Encoding, target: Encoding) -> NDArray[Any]:
    """A copy of the image in another encoding.

    Raises CvBridgeError if the two have nothing to do with each other: a colour cannot be made
    from an encoding that names none, nor the other way with another number of channels.
    """
    if source.name == target.name:
        return np.array(image)
    converted = image
    if not (source.colour and target.colour):
        if source.channels != target.channels or target.colour:
            msg = f"cannot convert an image of encoding {source.name!r} to {target.name!r}"
            raise CvBridgeError(msg)
    elif source.colour != target.colour:
        converted = _convert_colour(image, source, target)
    converted = _convert_depth(converted, target.dtype)
    return np.array(image) if converted is image else converted


def _convert_colour(image: NDArray[Any], source: Encoding, target: Encoding) -> NDArray[Any]:
    if source.colour.startswith("YUV"):
        kind = source.colour.removeprefix("YUV_")
        code = getattr(cv2, f"COLOR_YUV2{target.colour}_{kind}", None)
    else:
        code = getattr(cv2, f"COLOR_{source.colour}2{target.colour}", None)
    if code is None:
        msg = f"cannot convert an image of encoding {source.name!r} to {target.name!r}"
        raise CvBridgeError(msg)
    try:
        return np.asarray(cv2.cvtColor(image, code))
    except cv2.error as error:
        msg = f"cannot convert an image of encoding {source.name!r} to {target.name!r}: {error.err}"
        raise CvBridgeError(msg) from None


def _convert_depth(image: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """The image as `dtype`, rounded and saturated; 8 and 16 bit cover the same range of light."""
    if image.dtype == dtype:
        return image
    scale = {(1, 2): 65535 / 255, (2, 1): 255 / 65535}.get(
        (image.dtype.itemsize, dtype.itemsize), 1.0
    )
    values = image * scale
    if dtype.kind == "f":
        return np.asarray(values, dtype)
    limits = np.iinfo(dtype)
    return np.asarray(np.clip(np.rint(values), limits.min, limits.max), dtype)
