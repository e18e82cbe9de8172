"""The ROS side of a live simulated sensor: commands in, truth out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from cmp_tactile_driver.sources.frames import Frame
from cmp_tactile_msgs.msg import ForceField, Grid, Surface
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.ros.messages import conversions
from cmp_tactile_processing.ros.messages.making import gel_frame, view_frame
from cmp_tactile_processing.ros.parameters import declare_checked, describe
from cmp_tactile_simulation.contact.laws import Load, Pose
from cmp_tactile_simulation.live.mechanics import LiveSettings, Reset
from cmp_tactile_simulation.live.sensor import LiveFrame, TruthWanted

if TYPE_CHECKING:
    from cmp_tactile_simulation.live.source import SimulatedSource

DEPTH = 10
WARNING_PERIOD_S = 5.0
NORM_TOLERANCE = 1e-2
GRIDS = {"left": "truth/left/grid", "right": "truth/right/grid"}


class LiveSource:
    """Lets a node move the indenter of a simulated source, and publish what is true of its frames.

    The node's parameters are declared with its first simulated source and stay.
    Raises InputError for a wrong one.
    """

    def __init__(self, node: Any, source: SimulatedSource) -> None:
        self._node = node
        self._source = source
        # One of several sensors of one description has frames of its own.
        name = node.get_parameter_or("sensor_name").value
        scene_sensor = source.scene.sensor
        self._description = replace(scene_sensor, name=name) if name else scene_sensor
        self._gel_frame = gel_frame(self._description)
        self._refused = ""
        source.settings = _declare_settings(node)
        self._subscriptions = [
            node.create_subscription(kind, topic, self._guarded(topic, command), DEPTH)
            for kind, topic, command in (
                (PoseStamped, "indenter/target", self._on_target),
                (WrenchStamped, "indenter/load", self._on_load),
            )
        ]
        self._service = node.create_service(Trigger, "indenter/reset", self._on_reset)
        self._pose = node.create_publisher(PoseStamped, "indenter/pose", DEPTH)
        self._surface = node.create_publisher(Surface, "truth/surface", DEPTH)
        self._force = node.create_publisher(ForceField, "truth/force_field", DEPTH)
        self._grids = {
            view: node.create_publisher(Grid, topic, DEPTH) for view, topic in GRIDS.items()
        }

    @property
    def diagnostics(self) -> Mapping[str, object]:
        """What the simulated source does, and the last command that was refused."""
        return {**self._source.diagnostics, "refused": self._refused}

    def frame_sent(self, frame: Frame, header: Header) -> None:
        """Publish what is true of a frame, with its stamp; only what somebody subscribes to."""
        optics = (self._surface, *self._grids.values())
        self._source.wanted = TruthWanted(
            force=self._force.get_subscription_count() > 0,
            optics=any(publisher.get_subscription_count() for publisher in optics),
        )
        if not isinstance(frame, LiveFrame):
            return
        in_gel = conversions.header_at(header.stamp, self._gel_frame)
        if frame.pose is not None:
            self._pose.publish(_pose_to_msg(frame.pose, in_gel))
        if frame.force is not None:
            self._force.publish(conversions.force_field_to_msg(frame.force, in_gel))
        if frame.surface is not None:
            self._surface.publish(conversions.surface_to_msg(frame.surface, in_gel))
        for view, grid in (frame.grids or {}).items():
            in_view = conversions.header_at(header.stamp, view_frame(self._description, view))
            self._grids[view].publish(conversions.grid_to_msg(grid, in_view))

    def close(self) -> None:
        """Take everything but the parameters back from the node."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._node.destroy_service(self._service)
        for publisher in (self._pose, self._surface, self._force, *self._grids.values()):
            self._node.destroy_publisher(publisher)

    def _guarded(self, topic: str, command: Callable[[Any], None]) -> Callable[[Any], None]:
        """A callback that refuses what it cannot use, with a warning; what was asked for stays."""
        name = self._node.resolve_topic_name(topic)

        def on_message(message: Any) -> None:
            try:
                self._check_frame(message.header)
                command(message)
            except InputError as error:
                self._refused = f"{name}: {error}"
                self._node.get_logger().warning(
                    self._refused, throttle_duration_sec=WARNING_PERIOD_S
                )

        return on_message

    def _check_frame(self, header: Header) -> None:
        if header.frame_id != self._gel_frame:
            msg = f"header.frame_id: found {header.frame_id!r}, expected {self._gel_frame!r}"
            raise InputError(msg)

    def _on_target(self, message: PoseStamped) -> None:
        self._source.command(_pose_of(message))

    def _on_load(self, message: WrenchStamped) -> None:
        force, torque = message.wrench.force, message.wrench.torque
        self._source.command(Load(-force.z, (force.x, force.y), torque.z))

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._source.command(Reset())
        response.success = True
        response.message = f"{self._source.name}: from the beginning"
        return response


def _declare_settings(node: Any) -> LiveSettings:
    values = {}
    for item in fields(LiveSettings):
        if node.has_parameter(item.name):
            values[item.name] = node.get_parameter(item.name).value
        else:
            descriptor = describe(item, read_only=True)
            values[item.name] = declare_checked(node, item.name, item.default, descriptor)
    return LiveSettings(**values)


def _pose_of(message: PoseStamped) -> Pose:
    p, q = message.pose.position, message.pose.orientation
    quaternion = np.array([q.x, q.y, q.z, q.w])
    norm = float(np.linalg.norm(quaternion))
    if not abs(norm - 1.0) <= NORM_TOLERANCE:
        msg = f"orientation: found a quaternion of length {norm:g}, expected 1"
        raise InputError(msg)
    return Pose(np.array([p.x, p.y, p.z]), Rotation.from_quat(quaternion).as_matrix())


def _pose_to_msg(pose: Pose, header: Header) -> PoseStamped:
    message = PoseStamped(header=header)
    p, q = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = pose.position.tolist()
    q.x, q.y, q.z, q.w = Rotation.from_matrix(pose.rotation).as_quat().tolist()
    return message
