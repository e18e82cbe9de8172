"""Node: a gripper with two sensors holds an object in MuJoCo, in place of robot and cameras."""

from __future__ import annotations

import math
import sys
import threading
import time
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from tf2_ros import TransformBroadcaster
from visualization_msgs.msg import Marker

from cmp_tactile_driver.nodes.camera_calibration import camera_info_of, image_qos
from cmp_tactile_driver.sources.capture import Worker
from cmp_tactile_processing.errors import CmpTactileError, Finding, Severity
from cmp_tactile_processing.measured import NS_PER_S
from cmp_tactile_processing.ros.base_nodes import ReportingNode, latched_qos
from cmp_tactile_processing.ros.diagnostics import SentFrames
from cmp_tactile_processing.ros.messages.conversions import (
    ROS_MESSAGES,
    frame_to_msg,
    with_header,
)
from cmp_tactile_processing.ros.messages.making import camera_frame, gel_frame
from cmp_tactile_processing.ros.parameters import declare_parameters
from cmp_tactile_processing.ros.process import run_node
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parameters import parameter
from cmp_tactile_simulation.contact.laws import Pose
from cmp_tactile_simulation.grasp.body import OBJECT_FRAME, object_marker
from cmp_tactile_simulation.grasp.live import COMMAND, GraspMoment, LiveGrasp, LiveGraspSettings
from cmp_tactile_simulation.grasp.scene import SIDES, load_grasp
from cmp_tactile_simulation.grasp.world import load_mujoco
from cmp_tactile_simulation.recording.truth import pose_message, transform_message

Array = NDArray[np.float64]
# The simulation calls MuJoCo some 20,000 times a second.  After each call it waits for the GIL for
# so long, s, where another thread is busy in Python; by default 5 ms.
SWITCH_S = 1e-4
# Commands are taken, and clock and opening published, about so often, s of simulated time.
CHUNK_S = 0.01
# A lag of up to this, s, is caught up with; what is beyond it is given up.
LATEST_S = 0.5
# A grasp that failed is reported for so long, s of simulated time.
REPORTED_S = 10.0


@dataclass(frozen=True)
class GraspSimulatorParameters(LiveGraspSettings):
    """What is simulated, and how its frames are named."""

    scene: str = parameter("box", "grasp to simulate: packaged name or file (docs/grasp.md)")
    sensor_names: str = parameter(
        "left_finger right_finger", "names of the left and the right sensor, also of their topics"
    )
    world_frame: str = parameter("world", "tf frame of the table")
    gripper_frame: str = parameter("gripper", "tf frame between the fingertips, y to the left one")
    publish_clock: bool = parameter(True, "publish the simulated time on /clock")


class GraspSimulator(ReportingNode):
    """Simulates a gripper that holds an object (docs/grasp.md), in real time where it can.

    Publishes frames of both sensors, tf of the gel frames and the object, and what is true.
    Stamps are in simulated time, which begins with the system's and is slower where the computer
    is: let all nodes use /clock (`use_sim_time`).
    With `drive` command, `gripper/command` sets the opening of the fingers in m, and the motion of
    the scene goes on once the object is held for a second.  `gripper/controls` sets actuators by
    name (`position` has their values).  `~/restart` begins again.
    If a gel cannot follow, the diagnostics say why, and the grasp begins again.
    Raises CmpTactileError for a wrong scene or parameter, and without MuJoCo.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("grasp_simulator", **node_kwargs)
        self._worker = Worker("grasp", self._run)
        with self.destroyed_on_error():
            self._set_up()
        self._worker.start()

    def destroy_node(self) -> None:
        """Stop simulating, then destroy the node."""
        self._worker.stop()
        super().destroy_node()

    def _set_up(self) -> None:
        self._own = declare_parameters(self, GraspSimulatorParameters())
        load_mujoco()
        self._scene = load_grasp(self._own.scene)
        self._rate = self._own.rate or self._scene.rate
        names = self._own.sensor_names.split()
        if len(names) != len(SIDES):
            msg = f"parameter sensor_names: found {names}, expected two names"
            raise CmpTactileError(msg)
        self._fingers = {
            side: _Finger(self, replace(self._scene.described[side], name=name))
            for side, name in zip(SIDES, names, strict=True)
        }
        self._transforms = TransformBroadcaster(self)
        self._object = self.create_publisher(PoseStamped, "object/pose", 10)
        # Held, or a late subscriber would not get it.
        self._marker = self.create_publisher(Marker, "object/marker", latched_qos())
        self._marker.publish(object_marker(ROS_MESSAGES, self._scene))
        self._opening = self.create_publisher(Float64, "gripper/opening", 10)
        self._clock_publisher = self.create_publisher(Clock, "/clock", QoSProfile(depth=10))
        self.create_subscription(Float64, "gripper/command", self._on_command, 10)
        self.create_subscription(JointState, "gripper/controls", self._on_controls, 10)
        self.create_service(Trigger, "~/restart", self._on_restart)
        self._grasp: LiveGrasp | None = None
        self._note = self._problem = ""
        self._problem_s = 0.0
        self._asked = threading.Event()
        self._sent = SentFrames()
        self._passed = 0.0, time.monotonic()
        self._time_s = 0.0
        self.start_reporting()
        self.warn_of_unknown_parameters()

    def _on_command(self, message: Float64) -> None:
        if not math.isfinite(message.data):
            self._warn(f"gripper/command: found {message.data}, expected an opening in m")
        elif self._scene.model and not self._scene.servo and self._own.drive == COMMAND:
            self._warn(f"gripper/command: found no key servo in {self._scene.file}, expected it")
        elif self._grasp is not None:
            self._grasp.command = message.data

    def _on_controls(self, message: JointState) -> None:
        if self._grasp is None:
            return
        values = dict(zip(message.name, message.position, strict=False))
        unknown = values.keys() - self._grasp.actuators
        if len(values) < len(message.name) or not all(map(math.isfinite, values.values())):
            self._warn(f"gripper/controls: found {values}, expected a finite position of each name")
        elif unknown:
            known = ", ".join(self._grasp.actuators)
            self._warn(f"gripper/controls: found {min(unknown)}, expected names of {known}")
        else:
            self._grasp.controls = values

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text, throttle_duration_sec=5.0)

    def _on_restart(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._asked.set()
        response.success, response.message = True, f"{self._scene.name}: from the beginning"
        return response

    def _on_progress(self, what: str, share: float) -> None:
        self._note = f"{what}, {100 * share:.0f} %"
        if self._worker.stopping:
            raise CancelledError

    def _run(self) -> None:
        """The thread of the simulation."""
        sys.setswitchinterval(SWITCH_S)
        try:
            grasp = self._grasp = LiveGrasp(self._scene, self._own, self._on_progress)
        except CancelledError:
            return
        except CmpTactileError as error:
            self.get_logger().error(str(error))
            raise
        chunks = max(1, round(1 / self._rate / CHUNK_S))
        chunk, number = 1 / self._rate / chunks, 0
        began_ns, due = time.time_ns(), time.monotonic()
        # Frames are drawn on a thread of their own while the grasp goes on.
        with ThreadPoolExecutor(max_workers=1) as drawing:
            drawn: Future[None] | None = None
            while not self._worker.wait(max(0.0, due - time.monotonic())):
                due = max(due + chunk, time.monotonic() - LATEST_S)
                self._time_s = number * chunk
                stamp_ns = began_ns + round(self._time_s * NS_PER_S)
                self._publish_time(stamp_ns, grasp)
                try:
                    if self._asked.is_set():
                        self._asked.clear()
                        grasp.restart()
                    if number % chunks == 0:
                        if drawn is not None:
                            drawn.result()
                        drawn = drawing.submit(self._draw, stamp_ns, grasp, grasp.moment())
                        grasp.taken += all(item.is_seen for item in self._fingers.values())
                    grasp.advance(chunk)
                except CmpTactileError as error:
                    self._problem = f"{self._scene.name}: {grasp.phase}: {error}"
                    self._problem_s = self._time_s
                    self.get_logger().warning(f"{self._problem}; the grasp begins again")
                    grasp.restart()
                number += 1

    def _publish_time(self, stamp_ns: int, grasp: LiveGrasp) -> None:
        if self._own.publish_clock:
            self._clock_publisher.publish(Clock(clock=ROS_MESSAGES.time(stamp_ns)))
        self._opening.publish(Float64(data=grasp.opening))

    def _draw(self, stamp_ns: int, grasp: LiveGrasp, moment: GraspMoment) -> None:
        make, tips = ROS_MESSAGES, moment.fingertips
        world = make.header(stamp_ns, self._own.world_frame)
        middle = make.header(stamp_ns, self._own.gripper_frame)
        gripper = gripper_pose(*tips.values())
        transforms = [
            transform_message(make, self._own.gripper_frame, gripper, world),
            transform_message(make, OBJECT_FRAME, moment.held, world),
        ]
        transforms += [
            transform_message(make, gel_frame(finger.sensor), tips[side].seen_from(gripper), middle)
            for side, finger in self._fingers.items()
        ]
        self._transforms.sendTransform(transforms)
        self._object.publish(pose_message(make, moment.held, world))
        pictures = grasp.pictures(moment)
        for side, finger in self._fingers.items():
            finger.publish(stamp_ns, pictures[side], moment.wrenches[side])
        self._sent.sent()

    def _status(self) -> DiagnosticStatus:
        before, since = self._passed
        self._passed = now_s, now = self._time_s, time.monotonic()
        grasp = self._grasp
        if now_s > self._problem_s + REPORTED_S:
            self._problem = ""
        findings = [
            Finding(Severity.ERROR, self._worker.failure),
            Finding(Severity.WARNING, self._problem),
        ]
        values = {
            "phase": self._note or "starting" if grasp is None else grasp.phase,
            "opening (mm)": "" if grasp is None else f"{1e3 * grasp.opening:.2f}",
            "share of real time": f"{(now_s - before) / max(now - since, 1e-9):.2f}",
            **self._sent.close_period(),
            "problem": self._worker.failure or self._problem,
        }
        return self.status_of(self._scene.name, values, findings, "simulating")


class _Finger:
    """The topics of one sensor."""

    def __init__(self, node: GraspSimulator, sensor: SensorDescription) -> None:
        self.sensor, name = sensor, sensor.ros_name
        self._image = node.create_publisher(Image, f"{name}/image_raw", image_qos())
        self._info = node.create_publisher(CameraInfo, f"{name}/camera_info", image_qos())
        self._truth = node.create_publisher(WrenchStamped, f"{name}/truth/wrench", 10)
        self._calibration = camera_info_of(sensor, ROS_MESSAGES.header(0, camera_frame(sensor)))

    @property
    def is_seen(self) -> bool:
        """Whether somebody subscribes to the frames."""
        return self._image.get_subscription_count() > 0

    def publish(self, stamp_ns: int, image: NDArray[np.uint8], wrench: Array) -> None:
        make = ROS_MESSAGES
        header = make.header(stamp_ns, camera_frame(self.sensor))
        self._info.publish(with_header(self._calibration, header))
        self._image.publish(frame_to_msg(image, header))
        in_gel = make.header(stamp_ns, gel_frame(self.sensor))
        self._truth.publish(WrenchStamped(header=in_gel, wrench=make.wrench(wrench)))


def gripper_pose(left: Pose, right: Pose) -> Pose:
    """The frame in the middle of two gel frames: y towards the left one, x along its x axis."""
    y = left.position - right.position
    y /= np.linalg.norm(y)
    x = left.rotation[:, 0] - (left.rotation[:, 0] @ y) * y
    x /= np.linalg.norm(x)
    middle = (left.position + right.position) / 2
    return Pose(middle, np.stack([x, y, np.cross(x, y)], axis=1))


def main() -> int:
    """Run the node as a process."""
    return run_node(GraspSimulator)


if __name__ == "__main__":
    sys.exit(main())
