"""What the recorder writes of a message: its bytes, and frames compressed."""

from __future__ import annotations

import array
from collections.abc import Callable
from typing import Any

import cv2
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage, Image

from cmp_tactile_driver.bags.reader import COMPRESSED_IMAGE, IMAGE
from cmp_tactile_driver.bags.recorder import EncodedMessage
from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.image.compressed import COMPRESSED
from cmp_tactile_processing.ros.messages.reading import image_from_msg

ENCODED = ("mono8", "bgr8", "rgb8")
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
        return EncodedMessage(topic, kind, serialize_message(message))

    return encode


def frame_encoder(topic: str, codec: str, quality: int) -> Callable[[Image], EncodedMessage]:
    """Encodes Images as CompressedImages on TOPIC/compressed.  codec: "png" or "jpeg".

    Frames in other encodings than mono8, bgr8 and rgb8 stay as they are, on their own topic.
    """
    options = PNG_OPTIONS if codec == "png" else (cv2.IMWRITE_JPEG_QUALITY, quality)
    suffix = ".png" if codec == "png" else ".jpg"
    as_it_is = message_encoder(topic, IMAGE)

    def encode(message: Image) -> EncodedMessage:
        if message.encoding not in ENCODED:
            return as_it_is(message)
        done, content = cv2.imencode(suffix, image_from_msg(message), options)
        if not done:
            msg = (
                f"width, height: found {message.width} x {message.height} px, expected a size that "
                f"{codec} supports"
            )
            raise FrameError(msg)
        target = "" if message.encoding == "mono8" else "bgr8"
        compressed = CompressedImage(
            header=message.header, format=f"{message.encoding}; {codec} compressed {target}"
        )
        compressed.data = array.array("B", content.tobytes())
        return EncodedMessage(topic + COMPRESSED, COMPRESSED_IMAGE, serialize_message(compressed))

    return encode
