"""The messages of a simulated frame, serialised as ROS 2 does, without ROS."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.ros.frames import camera_frame, gel_frame, view_frame
from cmp_tactile_processing.ros.messages.definitions import bag_messages, simulation_typestore
from cmp_tactile_processing.ros.messages.making import (
    CAMERA_INFO,
    FORCE_FIELD,
    GRID,
    SURFACE,
    whole_frame_info,
)
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.contact.state import Pose
from cmp_tactile_simulation.scenes.simulation import SimulatedFrame

__all__ = ["FrameMessages", "FrameTopics", "encode_png", "recorded_topics"]

COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
# Camera noise leaves PNG's dictionary nothing to find: entropy coding alone is both the smallest
# (21.9 MB against 23.8 MB for 60 frames) and seven times as fast.  OpenCV uses the strategy only
# where a compression level is given too.
PNG_OPTIONS = (
    cv2.IMWRITE_PNG_COMPRESSION,
    6,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
)


def encode_png(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The bytes (n,) of an image as lossless PNG."""
    return np.asarray(cv2.imencode(".png", image, PNG_OPTIONS)[1], np.uint8).ravel()


class FrameTopics(NamedTuple):
    """Topics of a recording by their names below the sensor's namespace, with message types."""

    prefix: str
    types: dict[str, str]


def recorded_topics(sensor: SensorDescription) -> FrameTopics:
    """The topics of a sensor's simulated recording, in the order of their messages."""
    types = {
        "camera_info": CAMERA_INFO,
        "image_raw/compressed": COMPRESSED_IMAGE,
        "truth/surface": SURFACE,
        "truth/force_field": FORCE_FIELD,
        **{f"truth/{view}/grid": GRID for view in sensor.views},
        "truth/indenter_pose": POSE_STAMPED,
    }
    return FrameTopics(f"/{sensor.ros_name}/", types)


class FrameMessages:
    """Makes the messages of one sensor's frames.

    Raises MessageDefinitionError where the suite's message definitions are not installed.
    """

    def __init__(self, sensor: SensorDescription) -> None:
        self._sensor, self._make = sensor, bag_messages()
        self._topics = recorded_topics(sensor)
        self._info = whole_frame_info(sensor)

    def serialised(self, frame: SimulatedFrame) -> Iterator[tuple[str, memoryview]]:
        """Topic (below the namespace) and CDR bytes of all messages of a frame, in order."""
        make = self._make
        camera = make.header(frame.stamp_ns, camera_frame(self._sensor))
        gel = make.header(frame.stamp_ns, gel_frame(self._sensor))
        messages = {
            "camera_info": make.camera_info(self._info, camera),
            "image_raw/compressed": make.new(
                COMPRESSED_IMAGE,
                header=camera,
                format="mono8; png compressed ",
                data=encode_png(frame.image),
            ),
            "truth/surface": make.surface(frame.surface, gel),
            "truth/force_field": make.force_field(frame.force, gel),
            **{
                f"truth/{view}/grid": make.grid(
                    grid, make.header(frame.stamp_ns, view_frame(self._sensor, view))
                )
                for view, grid in frame.grids.items()
            },
            "truth/indenter_pose": self._pose(frame.pose, gel),
        }
        for topic, kind in self._topics.types.items():
            yield topic, simulation_typestore().serialize_cdr(messages[topic], kind)

    def _pose(self, pose: Pose, header: Any) -> Any:
        place = self._make.new(
            "geometry_msgs/msg/Pose",
            position=self._make.point(pose.position),
            orientation=self._make.quaternion(Rotation.from_matrix(pose.rotation)),
        )
        return self._make.new(POSE_STAMPED, header=header, pose=place)
