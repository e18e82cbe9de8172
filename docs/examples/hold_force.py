"""Holds a normal force with a gripper, and grips harder before the object slips.

Start a sensor, then `python3 docs/examples/hold_force.py --ros-args -p sensor:=my_sensor`.
With two sensors, `-p grasp:=/grasp_state` in place of the sensor holds the weaker force of both.
It takes the gripper's opening in m from `gripper/opening` and asks for one on `gripper/command`.
docs/gripper.md shows how to connect it to a real gripper and tune it; docs/grip_controller.md
explains how it works.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field, fields, replace
from typing import Any

import rclpy
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.utilities import remove_ros_args
from std_msgs.msg import Float64, String

from cmp_tactile_msgs.msg import ForceField, GraspState

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
LONGEST_S = 0.2  # a longer gap between two forces counts as that
PERIOD_S = 0.05  # of looking whether the sensor is still there


def setting(default: float, low: float, high: float, meaning: str) -> Any:
    """A number that is a parameter of the node."""
    return field(default=default, metadata={"range": (low, high), "meaning": meaning})


@dataclass(frozen=True)
class Settings:
    """Settings of the controller; all may change while it runs."""

    target_force: float = setting(2.0, 0.1, 100, "normal force to hold while nothing slips [N]")
    max_force: float = setting(8.0, 0.1, 100, "largest target; the gripper opens at 10 % more [N]")
    stiffest: float = setting(3000, 10, 1e6, "force per distance, of the stiffest object [N/m]")
    softest: float = setting(300, 10, 1e6, "the same of the softest, with gel and pads [N/m]")
    response_time: float = setting(0.1, 0, 2, "time constant of the gripper after a command [s]")
    gain: float = setting(0.3, 0.01, 0.5, "share of the error to correct within one delay")
    approach_speed: float = setting(0.003, 1e-5, 0.1, "closing speed before the touch [m/s]")
    max_speed: float = setting(0.01, 1e-5, 0.5, "highest speed after the touch [m/s]")
    max_lead: float = setting(0.005, 1e-5, 0.5, "largest difference of command and opening [m]")
    slip_margin: float = setting(0.7, 0.1, 1, "largest share of the friction to use")
    slip_share: float = setting(0.5, 0, 1, "share of the contact that may slide (its rim)")
    boost: float = setting(1.25, 1, 3, "factor of the target at a slip; 1: no reaction")
    relax_rate: float = setting(0.1, 0, 5, "share of the excess to remove each second")
    timeout: float = setting(0.2, 0.02, 10, "age from which a force is not used [s]")


@dataclass(frozen=True)
class Felt:
    """The values of a force field that the controller uses; normal in N, friction as a ratio."""

    normal: float
    ratio: float = math.nan
    friction: float = math.nan
    slip: int = ForceField.SLIP_UNKNOWN
    share: float = math.nan  # of the contact that slides
    flags: int = 0


class Grip:
    """The controller, without ROS: from the force to the opening to command, m."""

    def __init__(self, settings: Settings, opening: float) -> None:
        self.settings, self.opening = settings, opening
        self._factor = 1.0  # by which slip has raised the target
        self._touch = math.nan  # opening at which the object was touched first
        self._limit = math.inf  # of tangential over normal force; infinite until it is known

    @property
    def target(self) -> float:
        """The normal force to hold, N."""
        return min(self._factor * self.settings.target_force, self.settings.max_force)

    def update(self, felt: Felt, actual: float, dt: float, delay: float) -> str:
        """Change the opening; returns the action and its reason.

        actual: opening of the gripper, m.  dt: time since the last force, s.  delay: time from a
        command to the force that shows its effect, s.
        """
        s = self.settings
        if felt.flags & UNUSABLE or not math.isfinite(felt.normal):
            return f"still: the force is not usable, flags {felt.flags}"
        if felt.normal <= 0:  # no contact: forget the values of the last object
            self._factor, self._touch, self._limit = 1.0, math.nan, math.inf
            self._move(-s.approach_speed * dt, actual)
            return "closing: nothing is touched"
        if math.isnan(self._touch):
            # The gripper continued to close until this force came.
            self._touch = actual + s.approach_speed * (delay - s.response_time)
        raised, why = self._aim(felt, dt)
        stiffness, gain = self._stiffness(felt.normal, actual), s.gain
        if felt.normal > 1.1 * s.max_force:
            gain, why = 1.0, f"opening: more than {1.1 * s.max_force:g} N"
        # An integrator with a delay: stable while gain < pi/2, without overshoot below 1/e.
        way = gain / (stiffness * delay) * (felt.normal - self.target) * dt
        self._move(max(-s.max_speed * dt, min(way, s.max_speed * dt)) - raised / stiffness, actual)
        return why

    def _move(self, way: float, actual: float) -> None:
        """Open by `way`, but stay near a gripper that may be blocked, or it would jump later."""
        lead = self.settings.max_lead
        self.opening = min(max(0.0, actual - lead, self.opening + way), actual + lead)

    def _stiffness(self, normal: float, actual: float) -> float:
        """Force over the distance closed since the touch, N/m; `stiffest` until it is known."""
        way = self._touch - actual
        seen = normal / way if way > 0 else math.inf
        return max(self.settings.softest, min(seen, self.settings.stiffest))

    def _aim(self, felt: Felt, dt: float) -> tuple[float, str]:
        """Set the target; returns by how much it was raised, N, and why."""
        s, before = self.settings, self.target
        rim = felt.slip == ForceField.SLIP_INCIPIENT and not felt.share < s.slip_share
        slips = rim or felt.slip == ForceField.SLIP_FULL
        if 0 < felt.friction < math.inf:
            self._limit = s.slip_margin * felt.friction
        elif slips and felt.ratio > 0:  # the rim slides, long before the whole contact
            self._limit = min(self._limit, felt.ratio)
        why = "holding"  # a ratio that is NaN changes nothing
        if slips or felt.ratio > self._limit:
            why = "it slips" if slips else "close to slip"
            why = f"gripping harder: {why}" if s.boost > 1 else why
            if felt.normal > 0.9 * before and before < s.max_force:  # the last raise was felt
                self._factor *= s.boost
        elif felt.ratio < 0.8 * self._limit:
            self._factor += (1.0 - self._factor) * min(1.0, s.relax_rate * dt)
        return max(0.0, self.target - before), why


class HoldForce(Node):
    """Connects a `Grip` with a sensor and a gripper."""

    def __init__(self, **options: Any) -> None:
        super().__init__("hold_force", **options)
        sensor = self.declare_parameter("sensor", "sample_rig").value
        grasp = self.declare_parameter("grasp", "").value
        self._settings = Settings(**{item.name: self._declare(item) for item in fields(Settings)})
        self.add_on_set_parameters_callback(self._on_parameters)
        self._grip: Grip | None = None
        self._actual = self._stamp = math.nan
        self._age, self._said = 0.0, ""
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._last = self._steady.now()
        self._command = self.create_publisher(Float64, "gripper/command", 10)
        self._target = self.create_publisher(Float64, "gripper/target_force", 10)
        self._state = self.create_publisher(String, "gripper/state", 10)
        self.create_subscription(Float64, "gripper/opening", self._on_opening, 10)
        # Only the newest force counts.
        source = (GraspState, grasp) if grasp else (ForceField, f"/{sensor}/force_field")
        self.create_subscription(*source, self._on_force, 1)
        self.create_timer(PERIOD_S, self._on_timer, clock=self._steady)

    def _declare(self, item: Any) -> float:
        low, high = map(float, item.metadata["range"])
        descriptor = ParameterDescriptor(
            description=item.metadata["meaning"],
            floating_point_range=[FloatingPointRange(from_value=low, to_value=high)],
        )
        return self.declare_parameter(item.name, float(item.default), descriptor).value

    def _on_parameters(self, parameters: list[Any]) -> SetParametersResult:
        new = {p.name: p.value for p in parameters if hasattr(self._settings, p.name)}
        if not all(map(math.isfinite, new.values())):
            return SetParametersResult(successful=False, reason="found NaN, expected a number")
        self._settings = replace(self._settings, **new)
        if self._grip:
            self._grip.settings = self._settings
        return SetParametersResult(successful=True)

    def _on_opening(self, message: Float64) -> None:
        if math.isfinite(message.data):
            self._actual = message.data
            # Begins at the present opening, so that the gripper does not jump.
            self._grip = self._grip or Grip(self._settings, message.data)

    def _on_force(self, message: ForceField | GraspState) -> None:
        self._last, limit = self._steady.now(), self._settings.timeout
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        age, dt = 1e-9 * self.get_clock().now().nanoseconds - stamp, stamp - self._stamp
        self._stamp = stamp
        if self._grip is None:
            self._say("still: no gripper/opening yet")
        elif not -limit < age < limit:
            self._say(f"still: the force is {age:.2f} s old")
        elif dt > 0:
            dt, self._age = min(dt, LONGEST_S), max(age, 0.98 * self._age)
            delay = self._age + dt + self._settings.response_time
            self._say(self._grip.update(felt_in(message), self._actual, dt, delay))
        self._send()

    def _on_timer(self) -> None:
        waited = 1e-9 * (self._steady.now() - self._last).nanoseconds
        if waited > self._settings.timeout:
            self._say(f"still: no force for {self._settings.timeout:g} s")
            self._send()

    def _send(self) -> None:
        if self._grip:
            self._command.publish(Float64(data=self._grip.opening))
            self._target.publish(Float64(data=self._grip.target))

    def _say(self, state: str) -> None:
        if state != self._said:
            self._said = state
            self.get_logger().info(state)
            self._state.publish(String(data=state))


def felt_in(message: ForceField | GraspState) -> Felt:
    """The values that the controller uses; a press has a negative z."""
    one_finger = isinstance(message, ForceField)
    return Felt(
        -message.wrench.force.z if one_finger else min(message.normal_force),
        message.traction_ratio,
        message.friction_coefficient,
        message.slip_state,
        message.slip_ratio,
        message.flags,
    )


def main() -> None:
    """Hold until Ctrl-C."""
    explained = [
        f"  {item.name}: {item.metadata['meaning']}, default {item.default:g}"
        for item in fields(Settings)
    ]
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="\n".join(["parameters, each as -p NAME:=VALUE:", *explained]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.parse_args(remove_ros_args()[1:])
    rclpy.init()
    node = HoldForce()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
