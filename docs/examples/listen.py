"""Subscribes to the force of every frame and prints when the grip becomes firm or loose.

Start a sensor, such as `setup/run cmp_tactile replay grasp loop:=true`. Then, in another terminal:
`setup/run python3 docs/examples/listen.py`.
"""

from __future__ import annotations

import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from cmp_tactile_msgs.msg import ForceField

GRIP_LIMIT_N = 2.0
REPORT_PERIOD_S = 1.0
UNKNOWN = (
    ForceField.FLAG_FEW_MARKERS
    | ForceField.FLAG_BEYOND_MARKERS
    | ForceField.FLAG_POOR_FIT
    | ForceField.FLAG_IMPLAUSIBLE
    | ForceField.FLAG_ZERO_DOUBTFUL
    | ForceField.FLAG_DESCRIPTION_DOUBTFUL
    | ForceField.FLAG_SCALE_UNCERTAIN
)


class GripGuard(Node):
    """Prints when the grip becomes firm or loose, and the force once a second."""

    def __init__(self, sensor: str) -> None:
        super().__init__("grip_guard")
        self._firm = False
        self._latest: ForceField | None = None
        topic = f"/{sensor}/force_field"
        self.create_subscription(ForceField, topic, self._on_force, 10)
        self.create_timer(REPORT_PERIOD_S, self._report)
        print(f"listening to {topic}: firm is above {GRIP_LIMIT_N:g} N; Ctrl-C ends it", flush=True)

    def _on_force(self, msg: ForceField) -> None:
        self._latest = msg
        if msg.flags & UNKNOWN:
            return  # the force is NaN or that of something else: the grip is as it was
        # The force that the object exerts on the gel: a press has a negative z.
        firm = -msg.wrench.force.z > GRIP_LIMIT_N
        if firm != self._firm:
            self._firm = firm
            what = "firm" if firm else "loose"
            area_mm2 = 1e6 * msg.contact_area
            print(f"grip {what}: {-msg.wrench.force.z:.1f} N over {area_mm2:.0f} mm2", flush=True)

    def _report(self) -> None:
        msg, self._latest = self._latest, None
        if msg is None:
            print("no force came: does a sensor of this name run?", flush=True)
        elif msg.flags & UNKNOWN:
            print(f"no force can be given: flags {msg.flags}", flush=True)
        else:
            print(f"normal force: {-msg.wrench.force.z:.1f} N", flush=True)


def main(sensor: str = "sample_rig") -> None:
    """Listen until Ctrl-C."""
    rclpy.init()
    node = GripGuard(sensor)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main(*sys.argv[1:])
