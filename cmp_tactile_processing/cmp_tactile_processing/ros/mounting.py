"""Where a sensor is mounted: a frame of the robot, and the gel frame's pose in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from geometry_msgs.msg import TransformStamped
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.ros.frames import gel_frame, sensor_frames
from cmp_tactile_processing.ros.node_parameters import declare_parameters
from cmp_tactile_processing.ros.stage_node import StageNode
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parameters import check_parameters, parameter

__all__ = ["Mounting"]

# No gripper is larger, and mm or degrees in place of m or rad are seldom less.
FARTHEST_M = 10.0
MOST_RAD = 2 * math.pi
ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Mounting:
    """The gel frame's pose in the frame of a robot: the numbers of a URDF joint's origin."""

    parent_frame: str = parameter(
        "", "frame that the sensor is mounted on: tf joins the gel frame to it; empty for none"
    )
    mount_position: tuple[float, float, float] = parameter(
        ORIGIN,
        "gel frame's origin in parent_frame",
        unit="m",
        low=-FARTHEST_M,
        high=FARTHEST_M,
    )
    mount_orientation: tuple[float, float, float] = parameter(
        ORIGIN,
        "roll, pitch and yaw of the gel frame about parent_frame's fixed axes",
        unit="rad",
        low=-MOST_RAD,
        high=MOST_RAD,
    )

    def __post_init__(self) -> None:
        check_parameters(self)

    @classmethod
    def declare(cls, node: StageNode) -> Mounting:
        """From the parameters of the node.  Raises ParameterError where they cannot be meant."""
        mounting = declare_parameters(node, cls())
        parent, own = mounting.parent_frame, sensor_frames(node.sensor)
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
