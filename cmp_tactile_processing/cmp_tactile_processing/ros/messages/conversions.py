"""Messages of ROS's own classes, as nodes publish them, and the images of those they receive."""

from __future__ import annotations

import array
import copy
from contextlib import suppress
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from cv_bridge import CvBridge
from numpy.typing import NDArray
from std_msgs.msg import Header

from cmp_tactile_processing.geometry.split import LUMINANCE
from cmp_tactile_processing.image.encodings import BitDepth, check_raw, convert_raw
from cmp_tactile_processing.ros.messages.making import MessageMaker, encoding_of
from cmp_tactile_processing.ros.messages.reading import image_from_msg

BRIDGE = CvBridge()


@cache
def message_class(kind: str) -> Any:
    """The class of "sensor_msgs/msg/Image"; ImportError or AttributeError where there is none."""
    package, _, name = kind.split("/")
    return getattr(import_module(f"{package}.msg"), name)


def header_at(stamp: Any, frame_id: str) -> Header:
    """A header with the stamp of an input message and a frame of its own."""
    return Header(stamp=stamp, frame_id=frame_id)


def with_header(message: Any, header: Header) -> Any:
    """A message with a header of its own, which shares all else with the one given."""
    made = copy.copy(message)
    made.header = header
    return made


def _new(kind: str, **values: Any) -> Any:
    return message_class(kind)(**values)


def _array(values: NDArray[Any]) -> Any:
    """The type that messages take whole: any other is checked value by value."""
    filled = array.array(np.dtype(values.dtype).char)
    filled.frombytes(values.view(np.uint8).data)
    return filled


ROS_MESSAGES = MessageMaker(_new, _array)
camera_info_to_msg = ROS_MESSAGES.camera_info
force_field_to_msg = ROS_MESSAGES.force_field
grasp_state_to_msg = ROS_MESSAGES.grasp_state
grid_to_msg = ROS_MESSAGES.grid
organised_cloud = ROS_MESSAGES.cloud
surface_to_msg = ROS_MESSAGES.surface
wrench_to_msg = ROS_MESSAGES.wrench_stamped


def image_to_msg(image: NDArray[np.uint8], encoding: str, header: Header) -> Any:
    """The Image of pixels (H, W) or (H, W, 3)."""
    return BRIDGE.cv2_to_imgmsg(image, encoding, header)


def image_from_topic(
    msg: Any,
    weights: tuple[float, float, float] | None = LUMINANCE,
    depth: BitDepth | None = None,
) -> NDArray[np.uint8]:
    """As `image_from_msg`, by cv_bridge where that reads the pixels as they were sent.

    cv_bridge knows no planes and not every name of YUV.  It shears the image if a row ends within a
    pixel, and its byte swap fails with NumPy 2.
    """
    if not hasattr(msg, "format"):
        layout = check_raw((msg.width, msg.height), msg.encoding, msg.step, len(msg.data))
        is_plain = layout.planes == 1 and msg.step % layout.pixel_bytes == 0
        with suppress(TypeError):  # CvBridgeError is one
            if is_plain and not msg.is_bigendian:
                pixels = BRIDGE.imgmsg_to_cv2(msg)
                grey = weights == LUMINANCE
                return convert_raw(pixels, msg.encoding, luminance=grey, depth=depth)
    return image_from_msg(msg, weights, depth)


def frame_to_msg(image: NDArray[np.uint8], header: Header) -> Any:
    """The Image of a frame, (H, W) grey or (H, W, 3) BGR uint8."""
    return image_to_msg(image, encoding_of(image), header)
