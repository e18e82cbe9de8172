"""The shortest controller: zeroes a sensor, checks age and flags of each force, prints a command.

Start a sensor, then `python3 docs/examples/controller.py --ros-args -p sensor:=my_sensor`. With a
replay, add `-p use_sim_time:=true`. hold_force.py is a complete controller: it moves a gripper and
estimates the stiffness of the object.
"""

from __future__ import annotations

import argparse
import math

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.utilities import remove_ros_args
from std_srvs.srv import Trigger

from cmp_tactile_msgs.msg import ForceField

TARGET_N = 2.0
GAIN_M_PER_N = 0.05e-3  # less than 1 / (stiffness of gel, pads and object)
OLDEST_S = 0.2
# With these flags, do not use the force (docs/results.md, "Flags").
UNUSABLE = (
    ForceField.FLAG_FEW_MARKERS
    | ForceField.FLAG_BEYOND_MARKERS
    | ForceField.FLAG_POOR_FIT
    | ForceField.FLAG_IMPLAUSIBLE
    | ForceField.FLAG_ZERO_DOUBTFUL
    | ForceField.FLAG_DESCRIPTION_DOUBTFUL
    | ForceField.FLAG_SCALE_UNCERTAIN
)
# Reliable, like the publisher; only the newest message waits.
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


class Controller(Node):
    """Zeroes the sensor, then prints for each force how far to close the gripper."""

    def __init__(self) -> None:
        super().__init__("controller")
        sensor = self.declare_parameter("sensor", "sample_rig").value
        self._oldest = self.declare_parameter("oldest", OLDEST_S).value
        self._zero = self.create_client(Trigger, f"/{sensor}/stereo_triangulator/set_reference")
        # `wrench` has the same force without flags, for tools that do not know ForceField.
        self.create_subscription(ForceField, f"/{sensor}/force_field", self._on_force, NEWEST)
        self._zeroed = False

    def zero(self) -> None:
        """Take the present state as zero and wait for the answer; nothing may touch the gel."""
        print("waiting for the sensor", flush=True)
        self._zero.wait_for_service()
        while not self._zeroed:
            asked = self._zero.call_async(Trigger.Request())
            rclpy.spin_until_future_complete(self, asked)
            # Refused while no frames come, for example just after the start of the sensor.
            self._zeroed = asked.result().success
            print(f"zero: {asked.result().message}", flush=True)

    def _on_force(self, message: ForceField) -> None:
        if self._zeroed:
            print(self._command(message), flush=True)

    def _command(self, message: ForceField) -> str:
        # The stamp is that of the camera frame: the age includes exposure, transfer and computing.
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        age = 1e-9 * self.get_clock().now().nanoseconds - stamp
        normal = -message.wrench.force.z  # the force on the gel: a press has a negative z
        if not abs(age) < self._oldest:
            return f"hold: the force is {age:.2f} s old"
        if message.flags & UNUSABLE or not math.isfinite(normal):
            return f"hold: the force is not usable, flags {message.flags}"
        closing = GAIN_M_PER_N * (TARGET_N - normal)
        return f"felt {normal:.3f} N, {1e3 * age:.0f} ms old: close by {1e3 * closing:.5f} mm"


def main() -> None:
    """Zero, then command until Ctrl-C."""
    argparse.ArgumentParser(description=__doc__).parse_args(remove_ros_args()[1:])
    rclpy.init()
    node = Controller()
    try:
        node.zero()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
