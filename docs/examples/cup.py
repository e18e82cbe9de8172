"""Simulates a gripper that holds a cup while it is filled, and presses a simulated sensor.

Start three commands, each in a terminal:

    cmp_tactile live ball:16mm autoplay:=false params_file:=docs/examples/grip.yaml
    python3 docs/examples/hold_force.py --ros-args -p sensor:=prototype
    python3 docs/examples/cup.py

Time advances with the forces that the sensor reports. Pouring pauses while they are late, so a slow
computer changes little except the pace.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path

import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.task import Future
from rclpy.utilities import remove_ros_args
from std_msgs.msg import Bool, Float64, String
from std_srvs.srv import Trigger

from cmp_tactile_msgs.msg import ForceField
from cmp_tactile_simulation.scenes.file import load_scene

G = 9.81
STEP_S = 1e-3
LONGEST_S = 0.2  # a longer gap between two forces counts as that
AHEAD_N = 0.05  # by which the load may be ahead of what the sensor reports
GRIP_AHEAD_N = 0.3  # by which the grip may be
STILL_M = 2e-5  # a gripper that moves less in a second stands still
SLIDES_WITH = 0.95  # of the friction: the simulator solves no contact that carries more


@dataclass
class Cup:
    """A cup between two fingers that press equally; forces are those on one finger, in SI units.

    friction: coefficient between finger and cup.  stiffness: force per distance closed, N/m, of
    finger, gel and cup together.  lag: time constant of the gripper, s.
    """

    friction: float
    stiffness: float = 1500.0
    lag: float = 0.08
    width: float = 0.060
    opening: float = 0.063
    empty: float = 0.04
    water: float = 0.20
    pour: float = 8.0  # time of filling, s
    knock: float = 1.3  # factor of the weight for 0.2 s, 2 s after the end of filling
    time: float = 0.0
    begin: float = math.inf  # time of lifting, after the gripper was still around it for a second
    acted: float = 0.0  # time since lifting, without pauses
    slid: float = 0.0
    lost_after: float = 0.02
    _speed: float = field(default=0.0, repr=False)
    _stood: float = field(default=0.0, repr=False)
    _place: float = field(default=0.0, repr=False)

    @property
    def held(self) -> bool:
        """Whether the cup was filled and knocked, and is still held."""
        return self.acted >= self.pour + 6.0 and not self.lost

    @property
    def lost(self) -> bool:
        """Whether the cup slid out of the fingers."""
        return self.slid > self.lost_after

    @property
    def normal(self) -> float:
        """Normal force of each finger, N."""
        return 0.0 if self.lost else self.stiffness * max(0.0, self.width - self.opening)

    @property
    def mass(self) -> float:
        """Mass of cup and water, kg."""
        return self.empty + self.water * min(1.0, self.acted / self.pour)

    @property
    def asked(self) -> float:
        """Load that each finger must carry to hold the cup, N."""
        if math.isinf(self.begin):
            return 0.0  # the cup stands on the table
        knocked = 0 <= self.acted - (self.pour + 2.0) < 0.2
        return self.mass * G / 2 * (self.knock if knocked else 1.0)

    @property
    def tangential(self) -> float:
        """Load that each finger carries, N."""
        sliding = self._speed > 0 or self.asked > self.friction * self.normal
        most = (SLIDES_WITH if sliding else 1.0) * self.friction * self.normal
        return most if sliding else min(self.asked, SLIDES_WITH * self.friction * self.normal)

    def advance(self, command: float, duration: float, pause: bool = False) -> None:
        """Advance the time by `duration` with this commanded opening; `pause`: pour nothing."""
        for _ in range(round(duration / STEP_S)):
            self.time += STEP_S
            self.acted += 0.0 if pause or math.isinf(self.begin) else STEP_S
            self.opening += (command - self.opening) * STEP_S / self.lag
            self._lift()
            pull = 2 * (self.asked - self.friction * self.normal) / self.mass
            self._speed = max(0.0, self._speed + pull * STEP_S)
            self.slid += self._speed * STEP_S

    def _lift(self) -> None:
        if abs(self.opening - self._place) > STILL_M or not self.normal:
            self._place, self._stood = self.opening, 0.0
        self._stood += STEP_S
        if self._stood > 1.0:
            self.begin = min(self.begin, self.time)


@dataclass(frozen=True)
class Row:
    """State at one time; N, m, s."""

    time: float
    opening: float
    true_normal: float
    true_tangential: float
    asked: float
    slid: float
    felt_normal: float
    felt_tangential: float
    slip_state: int
    slip_ratio: float
    traction_ratio: float
    friction: float
    target: float
    state: str


class CupNode(Node):
    """Applies the commands to the cup, and the forces of the cup to the simulated sensor."""

    def __init__(self, cup: Cup, sensor: str) -> None:
        super().__init__("cup")
        self.cup, self.rows = cup, list[Row]()
        self._frame = f"{sensor}_gel_frame"
        self._stamp = self._command = self._target = math.nan
        self._state = ""
        self._opening = self.create_publisher(Float64, "gripper/opening", 10)
        self._truth = self.create_publisher(WrenchStamped, "cup/wrench", 10)
        self._slid = self.create_publisher(Float64, "cup/slid", 10)
        self._lost = self.create_publisher(Bool, "cup/lost", 10)
        self._load = self.create_publisher(WrenchStamped, f"/{sensor}/indenter/load", 10)
        self._reset = self.create_client(Trigger, f"/{sensor}/indenter/reset")
        zero = f"/{sensor}/stereo_triangulator/set_reference"
        self._zero, self._zeroed = self.create_client(Trigger, zero), False
        self.create_subscription(Float64, "gripper/command", self._on_command, 10)
        self.create_subscription(Float64, "gripper/target_force", self._on_target, 10)
        self.create_subscription(String, "gripper/state", self._on_state, 10)
        self.create_subscription(ForceField, f"/{sensor}/force_field", self._on_force, 10)

    def _on_command(self, message: Float64) -> None:
        self._command = message.data

    def _on_target(self, message: Float64) -> None:
        self._target = message.data

    def _on_state(self, message: String) -> None:
        self._state = message.data

    def wait_for_sensor(self) -> None:
        """Wait until the sensor runs."""
        while not self._zero.wait_for_service(timeout_sec=1.0):
            print("waiting for the sensor", flush=True)

    def take_reference(self) -> None:
        """Take a reference; only then publish the opening of the gripper."""
        self._zero.call_async(Trigger.Request()).add_done_callback(self._on_reference)

    def _on_reference(self, answer: Future) -> None:
        self._zeroed = answer.result().success
        if not self._zeroed:
            print(f"no reference: {answer.result().message}", flush=True)
            self.take_reference()

    def _on_force(self, message: ForceField) -> None:
        if not self._zeroed:
            return
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        duration, self._stamp = stamp - self._stamp, stamp
        if math.isfinite(self._command) and duration > 0 and not self.done:
            # Pouring waits while the simulated sensor is behind.
            force = message.wrench.force
            behind = self.cup.tangential - math.hypot(force.x, force.y)
            pause = not (behind < AHEAD_N and abs(self.cup.normal + force.z) < GRIP_AHEAD_N)
            self.cup.advance(self._command, min(duration, LONGEST_S), pause)
            self._press()
            self._note(message)
        self._opening.publish(Float64(data=self.cup.opening))

    @property
    def done(self) -> bool:
        """Whether the cup was filled and knocked, or lost."""
        return self.cup.lost or self.cup.held

    def let_go(self) -> None:
        """Remove the load from the sensor."""
        self._reset.call_async(Trigger.Request())

    def _press(self) -> None:
        cup, load = self.cup, WrenchStamped()
        load.header.frame_id = self._frame
        load.wrench.force.x, load.wrench.force.z = cup.tangential, -cup.normal
        self._truth.publish(load)
        if cup.normal > 0:
            self._load.publish(load)
        self._slid.publish(Float64(data=cup.slid))
        self._lost.publish(Bool(data=cup.lost))

    def _note(self, message: ForceField) -> None:
        cup, force = self.cup, message.wrench.force
        row = Row(
            cup.time,
            cup.opening,
            cup.normal,
            cup.tangential,
            cup.asked,
            cup.slid,
            -force.z,
            math.hypot(force.x, force.y),
            message.slip_state,
            message.slip_ratio,
            message.traction_ratio,
            message.friction_coefficient,
            self._target,
            self._state,
        )
        if not self.rows or int(row.time * 2) != int(self.rows[-1].time * 2):
            print(
                f"{row.time:5.1f} s  felt {row.felt_normal:5.2f} N  true {row.true_normal:5.2f} N  "
                f"carries {row.true_tangential:5.2f} N of {row.asked:5.2f} N  "
                f"slid {1e3 * row.slid:4.1f} mm  {row.state}",
                flush=True,
            )
        self.rows.append(row)


def write(rows: list[Row], path: Path) -> None:
    """Write all rows as CSV."""
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(asdict(rows[0])))
        table.writeheader()
        table.writerows(asdict(row) for row in rows)


def options() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(
        description="Simulate a gripper that holds a cup while it is filled."
    )
    parser.add_argument("--scene", default="ball:16mm", help="scene of the simulated sensor")
    parser.add_argument(
        "--stiffness", type=float, default=Cup.stiffness, help="stiffness of the grip, N/m"
    )
    parser.add_argument("--pour", type=float, default=Cup.pour, help="time of filling, s")
    parser.add_argument("--csv", type=Path, help="write every time step into this CSV file")
    return parser.parse_args(remove_ros_args()[1:])


def main() -> int:
    """Run until the cup was filled and knocked, or lost, or Ctrl-C; returns 1 if it is not held."""
    asked = options()
    scene = load_scene(asked.scene)
    cup = Cup(scene.indenter.friction, stiffness=asked.stiffness, pour=asked.pour)
    rclpy.init()
    node = CupNode(cup, scene.sensor.name)
    try:
        node.wait_for_sensor()
        node.take_reference()
        while not node.done:
            rclpy.spin_once(node)
        node.let_go()
        for _ in range(20):  # so that the last messages are sent
            rclpy.spin_once(node, timeout_sec=0.05)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    if asked.csv and node.rows:
        write(node.rows, asked.csv)
    print(
        f"{'held' if cup.held else 'lost' if cup.lost else 'ended'}, slid {1e3 * cup.slid:.1f} mm"
    )
    return 0 if cup.held else 1


if __name__ == "__main__":
    sys.exit(main())
