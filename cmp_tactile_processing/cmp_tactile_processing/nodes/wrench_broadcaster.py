"""Node: the wrench of a sensor in a frame of the robot, as controllers read it."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from std_msgs.msg import Bool, Header

from cmp_tactile_msgs.msg import ForceField as ForceFieldMsg
from cmp_tactile_processing.errors import Finding, Severity
from cmp_tactile_processing.force.advice import UNUSABLE, flag_names
from cmp_tactile_processing.force.grasp import wrench_transform
from cmp_tactile_processing.measured import NS_PER_S, ForceField
from cmp_tactile_processing.ros.base_nodes import InputNode
from cmp_tactile_processing.ros.messages.conversions import ROS_MESSAGES
from cmp_tactile_processing.ros.messages.reading import force_field_from_msg, stamp_ns
from cmp_tactile_processing.ros.parameters import StageParameters
from cmp_tactile_processing.ros.process import run_node
from cmp_tactile_processing.ros.transforms import FramePoses
from cmp_tactile_processing.sensor.parameters import Parameters, parameter

ORIGIN = np.zeros(3)
NO_WRENCH = np.full(6, np.nan)


@dataclass(frozen=True)
class BroadcasterParameters(Parameters):
    """Where, how often and how smooth the wrench is."""

    frame_id: str = parameter(
        "", "tf frame of the wrench, the moment about its origin; empty for the gel frame"
    )
    force_on: str = parameter(
        "sensor",
        "the wrench acts on the sensor (by the object) or on the object (by the sensor)",
        choices=("sensor", "object"),
    )
    rate: float = parameter(
        0.0, "rate of publishing; 0: with each force", unit="Hz", within=(0.0, 1000.0)
    )
    filter_cutoff: float = parameter(
        0.0, "cut-off of a low-pass of first order; 0: no filter", unit="Hz", within=(0.0, 1000.0)
    )
    timeout: float = parameter(
        0.2, "time without a force after which the wrench is NaN", unit="s", within=(0.01, 60.0)
    )


class LowPass:
    """First-order low-pass: exact for an input that stays as it is until the next one."""

    def __init__(self) -> None:
        self._value: NDArray[np.float64] | None = None
        self._stamp_ns = 0

    def forget(self) -> None:
        """Begin with the next value."""
        self._value = None

    def update(
        self, value: NDArray[np.float64], at_ns: int, cutoff_hz: float
    ) -> NDArray[np.float64]:
        """The filtered value at a stamp; cutoff_hz: 0 for the value itself."""
        passed_s = (at_ns - self._stamp_ns) / NS_PER_S
        self._stamp_ns = at_ns
        if self._value is None or not cutoff_hz or passed_s <= 0:
            self._value = value
        else:
            share = -math.expm1(-2 * math.pi * cutoff_hz * passed_s)
            self._value = self._value + share * (value - self._value)
        return self._value


class WrenchBroadcaster(InputNode):
    """Publishes `~/wrench` of a sensor in `frame_id`, as force_torque_sensor_broadcaster does.

    It has the stamp of the camera frame.  tf's newest transform is used.  While the force cannot be
    used (its flags say so), the transform is not known, or no force came for `timeout`, the wrench
    is NaN at once, `~/valid` (latched) is false and the diagnostics say why; a last value is never
    repeated.  The filter then begins again.
    """

    default_name = "wrench_broadcaster"

    def _set_up(self) -> None:
        self._given = StageParameters(self, BroadcasterParameters(), self._use)
        self._poses, self._filter = FramePoses(self), LowPass()
        self._wrench_publisher = self.add_publisher(WrenchStamped, "~/wrench")
        self._valid_publisher = self.add_publisher(Bool, "~/valid", depth=1, latched=True)
        self._frame = ""
        self._newest: WrenchStamped | None = None
        self._why_not: str | None = None  # valid where empty; None: nothing was published
        # The guard is reset by each force.
        self._guard = self.create_steady_timer(self._given.value.timeout, self._on_timeout)
        self._ticks = self.create_steady_timer(1.0, self._on_tick, autostart=False)
        self._use(self._given.value)
        self.add_input(
            ForceFieldMsg,
            "force_field",
            self._on_force,
            force_field_from_msg,
            needs_all=lambda: False,
        )

    def _use(self, given: BroadcasterParameters) -> None:
        self._filter.forget()
        self._guard.timer_period_ns = round(given.timeout * NS_PER_S)
        self._guard.reset()
        self._ticks.cancel()
        if given.rate:
            self._ticks.timer_period_ns = round(NS_PER_S / given.rate)
            self._ticks.reset()

    def _start_again(self, _topic: str) -> None:
        self._filter.forget()

    def _on_force(self, field: ForceField, header: Header) -> None:
        self._guard.reset()
        given = self._given.value
        self._frame = frame = given.frame_id or header.frame_id
        pose = np.eye(4) if frame == header.frame_id else self._poses.find(frame, header.frame_id)
        if field.flags & UNUSABLE or not np.isfinite(field.wrench).all():
            self._refuse(f"the force cannot be used: {flag_names(field.flags)}", header.stamp)
        elif pose is None:
            self._refuse(f"no transform from {header.frame_id} to {frame}", header.stamp)
        else:
            sign = 1.0 if given.force_on == "sensor" else -1.0
            wrench = sign * wrench_transform(pose, field.reference_point, ORIGIN) @ field.wrench
            at_ns = stamp_ns(header.stamp)
            self._take(self._filter.update(wrench, at_ns, given.filter_cutoff), header.stamp)
            self._report_valid("")
            if not given.rate:
                self._on_tick()

    def _on_timeout(self) -> None:
        text = f"no force for {self._given.value.timeout:g} s"
        self._refuse(text, self.get_clock().now().to_msg())

    def _refuse(self, why: str, stamp: Time) -> None:
        """Publish NaN, whatever the rate."""
        self._filter.forget()
        self._take(NO_WRENCH, stamp)
        self._report_valid(why)
        self._on_tick()

    def _take(self, wrench: NDArray[np.float64], stamp: Time) -> None:
        header = Header(stamp=stamp, frame_id=self._frame)
        self._newest = WrenchStamped(header=header, wrench=ROS_MESSAGES.wrench(wrench))

    def _on_tick(self) -> None:
        if self._newest is not None:
            self._wrench_publisher.publish(self._newest)
            self.frame_out(self._newest.header)

    def _report_valid(self, why_not: str) -> None:
        if self._why_not is None or bool(why_not) != bool(self._why_not):
            self._valid_publisher.publish(Bool(data=not why_not))
        self._why_not = why_not

    def _update_diagnostics(self) -> None:
        text = self._why_not or ""
        self.diagnostics.note = Finding(Severity.ERROR if text else Severity.OK, text)


def main() -> int:
    """Entry point of `ros2 run cmp_tactile_processing wrench_broadcaster`."""
    return run_node(WrenchBroadcaster)


if __name__ == "__main__":
    sys.exit(main())
