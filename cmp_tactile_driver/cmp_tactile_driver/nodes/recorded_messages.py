"""Messages as they go to a bag: as they are, or camera frames compressed."""

from __future__ import annotations

import array
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage, Image

from cmp_tactile_driver.bags.recorder import EncodedMessage
from cmp_tactile_driver.errors import ImageDecodingError

__all__ = ["frame_encoder", "message_encoder"]

COMPRESSED = "sensor_msgs/msg/CompressedImage"
IMAGE = "sensor_msgs/msg/Image"
CHANNELS = {"mono8": 1, "bgr8": 3, "rgb8": 3}
# Camera noise leaves PNG's dictionary nothing to find, and of its filters only the fixed ones are
# quick: 8 ms a frame of 1024 x 768 px instead of 15 to 150, at 5 % more bytes than the best.
PNG_OPTIONS = (
    cv2.IMWRITE_PNG_COMPRESSION,
    1,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_AVG,
)


def message_encoder(topic: str, kind: str) -> Callable[[Any], EncodedMessage]:
    """Encodes messages of a topic as they are."""

    def encode(message: Any) -> EncodedMessage:
        return EncodedMessage(topic, kind, serialize_message(message), _stamp_ns(message))

    return encode


def frame_encoder(topic: str, codec: str, quality: int) -> Callable[[Image], EncodedMessage]:
    """Encodes Images as CompressedImages on TOPIC/compressed.  codec: "png" or "jpeg".

    Frames in other encodings than mono8, bgr8 and rgb8 stay as they are, on their own topic.
    """
    options = PNG_OPTIONS if codec == "png" else (cv2.IMWRITE_JPEG_QUALITY, quality)
    suffix = ".png" if codec == "png" else ".jpg"
    as_it_is = message_encoder(topic, IMAGE)

    def encode(message: Image) -> EncodedMessage:
        if message.encoding not in CHANNELS:
            return as_it_is(message)
        done, content = cv2.imencode(suffix, _pixels(message), options)
        if not done:
            msg = f"width, height: {message.width} x {message.height} px cannot be made a {codec}"
            raise ImageDecodingError(msg)
        target = "" if message.encoding == "mono8" else "bgr8"
        compressed = CompressedImage(
            header=message.header, format=f"{message.encoding}; {codec} compressed {target}"
        )
        compressed.data = array.array("B", content.tobytes())
        return EncodedMessage(
            f"{topic}/compressed", COMPRESSED, serialize_message(compressed), _stamp_ns(message)
        )

    return encode


def _pixels(message: Image) -> NDArray[np.uint8]:
    """(H, W) grey or (H, W, 3) BGR."""
    channels = CHANNELS[message.encoding]
    width, height, step = message.width, message.height, message.step
    data = np.frombuffer(message.data, np.uint8)
    if not width or not height or step < width * channels or data.size != height * step:
        msg = (
            f"width, height, step, data: found {width} x {height} px of {channels} bytes, "
            f"{step} bytes a row, {data.size} bytes, which do not fit together"
        )
        raise ImageDecodingError(msg)
    rows = np.ascontiguousarray(data.reshape(height, step)[:, : width * channels])
    if channels == 1:
        return rows
    pixels = rows.reshape(height, width, channels)
    if message.encoding == "rgb8":
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), np.uint8)
    return pixels


def _stamp_ns(message: Any) -> int | None:
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return None if stamp is None else stamp.sec * 10**9 + stamp.nanosec
