"""Messages about the one real camera of a sensor."""

from __future__ import annotations

import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from cmp_tactile_processing.geometry.rectification import ROS_MODEL, ViewCameraInfo
from cmp_tactile_processing.ros.messages.camera_info import camera_info_to_msg
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["camera_info_of", "image_qos", "latched_qos"]


def image_qos() -> QoSProfile:
    """For frames and their camera_info.  A new one each time: rclpy writes overrides into it."""
    return QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


def latched_qos() -> QoSProfile:
    """For what late subscribers must get too."""
    return QoSProfile(
        depth=1,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def camera_info_of(sensor: SensorDescription, header: Header) -> CameraInfo:
    """The calibration of the whole frame, unrectified.

    A sensor with a camera per view has none: its K is zero, which ROS reads as uncalibrated.
    """
    width, height, camera = sensor.image.width, sensor.image.height, sensor.camera
    if camera is None:
        return CameraInfo(header=header, width=width, height=height)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    info = ViewCameraInfo(
        width=width,
        height=height,
        model=ROS_MODEL[camera.model],
        D=np.array(camera.distortion),
        K=K,
        R=np.eye(3),
        P=np.column_stack([K, np.zeros(3)]),
    )
    return camera_info_to_msg(info, header)
