"""Messages of ROS's own classes, as nodes publish them."""

from __future__ import annotations

import array
import copy
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Header

from cmp_tactile_processing.ros.messages.making import MessageMaker, encoding_of


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
grid_to_msg = ROS_MESSAGES.grid
image_to_msg = ROS_MESSAGES.image
organised_cloud = ROS_MESSAGES.cloud
surface_to_msg = ROS_MESSAGES.surface
wrench_to_msg = ROS_MESSAGES.wrench_stamped


def frame_to_msg(image: NDArray[np.uint8], header: Header) -> Any:
    """The Image of a frame, (H, W) grey or (H, W, 3) BGR uint8."""
    return image_to_msg(image, encoding_of(image), header)
