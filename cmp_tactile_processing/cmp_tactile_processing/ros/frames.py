"""Coordinate frames of a sensor, the static transforms between them, and where it is mounted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.node import Node
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.geometry.rectification import Rectification
from cmp_tactile_processing.ros.parameters import declare_parameters
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parameters import Parameters, parameter

__all__ = [
    "Mounting",
    "camera_frame",
    "gel_frame",
    "rectified_frame",
    "sensor_frames",
    "static_transforms",
    "view_frame",
]


def _named(sensor: SensorDescription, frame: str) -> str:
    """Frames of all sensors share one tree: each begins with the name of its sensor."""
    return f"{sensor.ros_name}_{frame}"


def gel_frame(sensor: SensorDescription) -> str:
    """The frame of the gel: origin at the apex of the undeformed surface, z towards the object."""
    return _named(sensor, "gel_frame")


def camera_frame(sensor: SensorDescription) -> str:
    """The optical frame of the one real camera."""
    return _named(sensor, "camera_optical_frame")


def view_frame(sensor: SensorDescription, view: str) -> str:
    """The optical frame of a view: in its virtual camera, turned as its rectified image is.

    Nodes of ROS take what they make of rectified images for points of the optical frame, and R of
    camera_info for the rotation from the view as published into it.
    """
    return _named(sensor, f"{view}_optical_frame")


def rectified_frame(sensor: SensorDescription, view: str) -> str:
    """The frame that camera_info and rectified image of a view carry.

    For both views of a pair it is the left one's: P of the right view takes points of that frame.
    """
    return view_frame(sensor, "left" if "left" in sensor.views else view)


def sensor_frames(sensor: SensorDescription) -> list[str]:
    """All frames of the sensor that tf tells of, the gel's first."""
    frames = [view_frame(sensor, name) for name in sensor.views]
    if sensor.optics.T_camera_gel is not None:
        frames.append(camera_frame(sensor))
    return [gel_frame(sensor), *sorted(frames)]


def static_transforms(
    sensor: SensorDescription, rectification: Rectification
) -> list[TransformStamped]:
    """From the gel frame to each optical frame, with stamp 0."""
    poses = {view_frame(sensor, name): rectification.pose(name) for name in sensor.views}
    if sensor.optics.T_camera_gel is not None:
        poses[camera_frame(sensor)] = sensor.optics.T_camera_gel
    return [_transform(gel_frame(sensor), child, T) for child, T in sorted(poses.items())]


def _transform(parent: str, child: str, T_child_parent: NDArray[np.float64]) -> TransformStamped:
    # A TransformStamped maps points of the child into the parent: T_parent_child.
    T = np.linalg.inv(T_child_parent)
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    translation, rotation = message.transform.translation, message.transform.rotation
    translation.x, translation.y, translation.z = T[:3, 3].tolist()
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    rotation.x, rotation.y, rotation.z, rotation.w = quaternion.tolist()
    return message


# No gripper is larger, and mm or degrees in place of m or rad are seldom less.
FARTHEST_M = 10.0
MOST_RAD = 2 * math.pi
ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Mounting(Parameters):
    """The gel frame's pose in the frame of a robot: the numbers of a URDF joint's origin."""

    parent_frame: str = parameter(
        "", "frame that the sensor is mounted on: tf joins the gel frame to it; empty for none"
    )
    mount_position: tuple[float, float, float] = parameter(
        ORIGIN, "gel frame's origin in parent_frame", unit="m", within=(-FARTHEST_M, FARTHEST_M)
    )
    mount_orientation: tuple[float, float, float] = parameter(
        ORIGIN,
        "roll, pitch and yaw of the gel frame about parent_frame's fixed axes",
        unit="rad",
        within=(-MOST_RAD, MOST_RAD),
    )

    @classmethod
    def declare(cls, node: Node, sensor: SensorDescription) -> Mounting:
        """From the parameters of the node.  Raises ParameterError where they cannot be meant."""
        mounting = declare_parameters(node, cls())
        parent, own = mounting.parent_frame, sensor_frames(sensor)
        if parent.startswith("/") or parent in own or parent != "".join(parent.split()):
            msg = (
                f"{node.get_fully_qualified_name()}: parameter parent_frame: found {parent!r}, "
                f"expected no blank, no / at its beginning, none of {', '.join(own)}"
            )
            raise ParameterError(msg)
        return mounting

    @property
    def is_elsewhere(self) -> bool:
        """Whether a pose is given."""
        return any(self.mount_position) or any(self.mount_orientation)

    def transforms(self, sensor: SensorDescription) -> list[TransformStamped]:
        """The one from parent_frame to the gel frame, with stamp 0; none without a parent."""
        if not self.parent_frame:
            return []
        message = TransformStamped(child_frame_id=gel_frame(sensor))
        message.header.frame_id = self.parent_frame
        translation, rotation = message.transform.translation, message.transform.rotation
        translation.x, translation.y, translation.z = self.mount_position
        quaternion = Rotation.from_euler("xyz", self.mount_orientation).as_quat()
        rotation.x, rotation.y, rotation.z, rotation.w = quaternion.tolist()
        return [message]
