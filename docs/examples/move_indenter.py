"""Presses, drags and releases the indenter of a live simulated sensor.

Start the sensor: `setup/run cmp_tactile live grasp`. Then, in another terminal:
`setup/run python3 docs/examples/move_indenter.py sample_rig`, with the name of the scene's sensor.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import rclpy
from geometry_msgs.msg import Point, PoseStamped, Vector3, WrenchStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from cmp_tactile_msgs.msg import ForceField, Surface

NORMAL_N = 2.0
DRAG_M = 0.5e-3
PATIENCE_S = 30.0
STARTING_S = 120.0  # for a simulator that still builds its gel


class Hand(Node):
    """Moves the indenter, and pairs the measured force with the true force of the same frame."""

    def __init__(self, sensor: str) -> None:
        super().__init__("hand", namespace=sensor)
        self.frame = f"{sensor}_gel_frame"
        self.pose: PoseStamped | None = None
        self.felt = self.true = Vector3()
        self.paired = (0, 0)
        self.has_reference = False
        self._truths: dict[tuple[int, int], Vector3] = {}
        self.load = self.create_publisher(WrenchStamped, "indenter/load", 10)
        self.target = self.create_publisher(PoseStamped, "indenter/target", 10)
        self.reset = self.create_client(Trigger, "indenter/reset")
        self.create_subscription(PoseStamped, "indenter/pose", self._on_pose, 10)
        self.create_subscription(ForceField, "truth/force_field", self._on_truth, 10)
        self.create_subscription(ForceField, "force_field", self._on_force, 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(Surface, "reference", self._on_reference, latched)

    def is_ready(self) -> bool:
        """Whether the simulator shows a pose and takes commands: one sent earlier is lost."""
        taken = all(topic.get_subscription_count() for topic in (self.load, self.target))
        return self.pose is not None and taken and self.reset.service_is_ready()

    def is_pressed(self) -> bool:
        """Whether the load is reached within 1 %."""
        return abs(self.true.z + NORMAL_N) < 0.01 * NORMAL_N

    def press(self, normal: float) -> None:
        """Request this force into the gel, N."""
        message = WrenchStamped()
        message.header.frame_id = self.frame
        message.wrench.force.z = -normal
        self.load.publish(message)

    def move_by(self, x: float) -> None:
        """Request a place at this distance along x, m."""
        here = self.pose.pose
        target = PoseStamped()
        target.header.frame_id = self.frame
        target.pose.orientation = here.orientation
        target.pose.position = Point(x=here.position.x + x, y=here.position.y, z=here.position.z)
        self.target.publish(target)

    def tell(self, what: str) -> None:
        """Print the latest pair of forces."""
        felt, true = (f"({f.x:5.2f}, {f.y:5.2f}, {f.z:5.2f}) N" for f in (self.felt, self.true))
        print(f"{what:8s} felt {felt}, true {true}", flush=True)

    def _on_pose(self, message: PoseStamped) -> None:
        self.pose = message

    def _on_reference(self, message: Surface) -> None:
        self.has_reference = message.reference_id > 0

    def _on_truth(self, message: ForceField) -> None:
        self._truths[stamp(message)] = message.wrench.force

    def _on_force(self, message: ForceField) -> None:
        # All messages of a frame have its stamp. The truth comes first: it needs no processing.
        if stamp(message) in self._truths:
            self.felt, self.true = message.wrench.force, self._truths[stamp(message)]
            self.paired = stamp(message)
            self._truths = {k: v for k, v in self._truths.items() if k > stamp(message)}


def stamp(message: ForceField | PoseStamped) -> tuple[int, int]:
    """Stamp of the camera frame, as seconds and nanoseconds."""
    return message.header.stamp.sec, message.header.stamp.nanosec


def wait(
    hand: Hand, condition: Callable[[], bool], failure: str, patience: float = PATIENCE_S
) -> None:
    """Receive messages until the condition is true; end the program after patience, in s."""
    deadline = time.monotonic() + patience
    while not condition():
        if time.monotonic() > deadline:
            sys.exit(f"{failure} within {patience:g} s")
        rclpy.spin_once(hand, timeout_sec=0.1)


def main(sensor: str = "sample_rig") -> None:
    """Press with 2 N, drag by half a millimetre, release."""
    rclpy.init()
    hand = Hand(sensor)
    try:
        wait(hand, hand.is_ready, f"found no live simulated sensor {sensor}", STARTING_S)
        # The sensor takes its zero while nothing touches the gel.
        wait(hand, lambda: hand.has_reference, "the sensor took no reference")
        hand.press(NORMAL_N)
        wait(hand, hand.is_pressed, "the sensor did not take the load")
        hand.tell("pressed")
        end = hand.pose.pose.position.x + DRAG_M
        hand.move_by(DRAG_M)
        wait(hand, lambda: hand.pose.pose.position.x > end - 1e-6, "the indenter did not arrive")
        there = stamp(hand.pose)
        wait(hand, lambda: hand.paired >= there, "the force did not follow")
        hand.tell("dragged")
        hand.reset.call_async(Trigger.Request())
        wait(hand, lambda: hand.true.z == 0, "the sensor was not released")
        hand.tell("released")
    finally:
        hand.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main(*sys.argv[1:])
