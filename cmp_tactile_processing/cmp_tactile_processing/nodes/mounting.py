"""Where a sensor is mounted: a frame of the robot, and the gel frame's pose in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from geometry_msgs.msg import TransformStamped
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.nodes.frames import gel_frame, sensor_frames
from cmp_tactile_processing.nodes.stage_node import StageNode
from cmp_tactile_processing.sensor_description import SensorDescription

__all__ = ["Mounting"]

# No gripper is larger, and mm or degrees in place of m or rad are seldom less.
FARTHEST_M = 10.0
MOST_RAD = 2 * math.pi
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Mounting:
    """parent_frame: empty for a sensor that is mounted nowhere.

    position, m, and orientation, roll, pitch and yaw about the parent's fixed axes in this order,
    rad, of the gel frame in the parent: the numbers of a URDF joint's origin, xyz and rpy.
    """

    parent_frame: str
    position: Vector
    orientation: Vector

    @classmethod
    def declare(cls, node: StageNode) -> Mounting:
        """From the parameters of the node.  Raises ParameterError where they cannot be meant."""
        parent: str = node.declare_fixed(
            "parent_frame",
            "",
            "frame that the sensor is mounted on: tf joins the gel frame to it; empty for none",
        )
        own = sensor_frames(node.sensor)
        if parent.startswith("/") or parent in own or parent != "".join(parent.split()):
            expected = f"no blank, no / at its beginning, none of {', '.join(own)}"
            raise _error(node, "parent_frame", parent, expected)
        return cls(
            parent,
            _declare_vector(
                node, "mount_position", "gel frame's origin in parent_frame", (FARTHEST_M, "m")
            ),
            _declare_vector(
                node,
                "mount_orientation",
                "roll, pitch and yaw of the gel frame about parent_frame's fixed axes",
                (MOST_RAD, "rad"),
            ),
        )

    @property
    def is_elsewhere(self) -> bool:
        """Whether a pose is given."""
        return any(self.position) or any(self.orientation)

    def transforms(self, sensor: SensorDescription) -> list[TransformStamped]:
        """The one from parent_frame to the gel frame, with stamp 0; none without a parent."""
        if not self.parent_frame:
            return []
        message = TransformStamped(child_frame_id=gel_frame(sensor))
        message.header.frame_id = self.parent_frame
        translation, rotation = message.transform.translation, message.transform.rotation
        translation.x, translation.y, translation.z = self.position
        quaternion = Rotation.from_euler("xyz", self.orientation).as_quat()
        rotation.x, rotation.y, rotation.z, rotation.w = quaternion.tolist()
        return [message]


def _declare_vector(node: StageNode, name: str, text: str, most: tuple[float, str]) -> Vector:
    limit, unit = most
    allowed = f"3 numbers from {-limit:.3g} to {limit:.3g}"
    value = node.declare_fixed(name, [0.0, 0.0, 0.0], f"{text} [{unit}]", allowed)
    found = [float(number) for number in value]
    # NaN is not within either.
    if len(found) != 3 or not all(abs(number) <= limit for number in found):
        raise _error(node, name, found, f"{allowed} {unit}")
    return found[0], found[1], found[2]


def _error(node: StageNode, name: str, found: object, expected: str) -> ParameterError:
    where = f"{node.get_fully_qualified_name()}: parameter {name}"
    return ParameterError(f"{where}: found {found!r}, expected {expected}")
