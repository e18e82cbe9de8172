"""What a gripper's controller needs of a sensor: zero, fresh and valid forces, a command a frame.

Beside a sensor that runs: `python3 docs/examples/controller.py --ros-args -p sensor:=my_sensor`;
beside a replay also `-p use_sim_time:=true`.  The command is only printed: hold_force.py moves a
gripper, and learns its stiffness.
"""

from __future__ import annotations

import math

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from cmp_tactile_msgs.msg import ForceField

TARGET_N = 2.0
GAIN_M_PER_N = 0.05e-3  # less than 1 / (stiffness of gel, pads and object)
OLDEST_S = 0.2
# With these the force is not that of the object (docs/results.md, "Flags").
UNUSABLE = (
    ForceField.FLAG_FEW_MARKERS
    | ForceField.FLAG_BEYOND_MARKERS
    | ForceField.FLAG_POOR_FIT
    | ForceField.FLAG_IMPLAUSIBLE
    | ForceField.FLAG_ZERO_DOUBTFUL
)
# Reliable, as results are published; of what waits only the newest counts.
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


class Controller(Node):
    """Zeroes the open gripper, then says by how much to close for each force."""

    def __init__(self) -> None:
        super().__init__("controller")
        sensor = self.declare_parameter("sensor", "sample_rig").value
        self._oldest = self.declare_parameter("oldest", OLDEST_S).value
        self._zero = self.create_client(Trigger, f"/{sensor}/stereo_triangulator/set_reference")
        # `wrench` has the same force without flags, for tools that know no ForceField.
        self.create_subscription(ForceField, f"/{sensor}/force_field", self._on_force, NEWEST)
        self._zeroed = False

    def zero(self) -> None:
        """Count the force from now on; nothing may touch the gel yet.  Waits for the answer."""
        print("waiting for the sensor", flush=True)
        self._zero.wait_for_service()
        while not self._zeroed:
            asked = self._zero.call_async(Trigger.Request())
            rclpy.spin_until_future_complete(self, asked)
            # Refused while no frames come, as when the sensor has just started.
            self._zeroed = asked.result().success
            print(f"zero: {asked.result().message}", flush=True)

    def _on_force(self, message: ForceField) -> None:
        if self._zeroed:
            print(self._command(message), flush=True)

    def _command(self, message: ForceField) -> str:
        # The stamp is that of the camera frame: exposure, transfer and computing are in the age.
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
