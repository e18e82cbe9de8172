"""Node: how two fingers hold an object."""

from __future__ import annotations

import sys
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from builtin_interfaces.msg import Time
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from cmp_tactile_msgs.msg import ForceField as ForceFieldMsg
from cmp_tactile_msgs.msg import GraspState as GraspStateMsg
from cmp_tactile_processing.errors import Finding, Severity
from cmp_tactile_processing.force.grasp import Finger, GraspEstimator, GraspFlag, GraspState
from cmp_tactile_processing.measured import NS_PER_S, ForceField
from cmp_tactile_processing.ros import rviz
from cmp_tactile_processing.ros.base_nodes import InputNode
from cmp_tactile_processing.ros.messages.conversions import grasp_state_to_msg
from cmp_tactile_processing.ros.messages.reading import force_field_from_msg, stamp_ns
from cmp_tactile_processing.ros.parameters import StageParameters
from cmp_tactile_processing.ros.process import run_node
from cmp_tactile_processing.ros.rviz_markers import grasp_markers
from cmp_tactile_processing.ros.transforms import FramePoses
from cmp_tactile_processing.sensor.parameters import Parameters, parameter

LEFT, RIGHT = "left", "right"
OTHER = {LEFT: RIGHT, RIGHT: LEFT}
# Forces of a finger that may wait for those of the other, which come later.
MAX_WAITING = 10
# Forces are paired up to this share of a period apart: with any more, the next one is nearer.
MAX_PAIRED_PERIODS = 0.6
MARKER_LIFETIME_S = 2.0


@dataclass(frozen=True)
class GraspParameters(Parameters):
    """How forces are paired, and what is not measured."""

    frame: str = parameter("gripper", "tf frame of the results")
    up_frame: str = parameter("world", "tf frame with z upwards, for the weight; empty for none")
    friction: float = parameter(
        0.0,
        "friction coefficient of gel and object, until slip has shown it; 0: unknown",
        within=(0.0, 10.0),
    )
    slop: float = parameter(
        0.05,
        "largest difference between the stamps of a pair of forces",
        unit="s",
        within=(0.0, 1.0),
    )
    timeout: float = parameter(
        0.2,
        "time without a pair of forces after which all is NaN and STALE",
        unit="s",
        within=(0.01, 60.0),
    )
    force_gain: float = parameter(
        0.005, "length of an arrow per force", unit="m/N", within=(0.0, 1e3)
    )


class Felt(NamedTuple):
    """A force field of one finger, and its header."""

    field: ForceField
    header: Header

    @property
    def stamp_ns(self) -> int:
        """Of its frame."""
        return stamp_ns(self.header.stamp)


class StampPairs:
    """Pairs the forces of two fingers by their stamps, each of them once."""

    def __init__(self) -> None:
        self._waiting: dict[str, deque[Felt]] = {}
        self._last_ns: dict[str, int] = {}
        self.forget()

    def forget(self) -> None:
        """Begin again."""
        self._waiting = {side: deque(maxlen=MAX_WAITING) for side in OTHER}
        self._last_ns = {}

    def add(self, side: str, felt: Felt, slop_ns: float) -> dict[str, Felt] | None:
        """Both forces by side, if the nearest of the other finger is near enough."""
        own, other = self._waiting[side], self._waiting[OTHER[side]]
        own.append(felt)
        period_ns = felt.stamp_ns - self._last_ns.get(side, -NS_PER_S)
        self._last_ns[side] = felt.stamp_ns
        nearest = min(other, key=lambda item: abs(item.stamp_ns - felt.stamp_ns), default=None)
        limit_ns = min(slop_ns, MAX_PAIRED_PERIODS * period_ns)
        if nearest is None or abs(nearest.stamp_ns - felt.stamp_ns) > limit_ns:
            return None
        while other.popleft() is not nearest:
            pass
        own.clear()
        return {side: felt, OTHER[side]: nearest}


class GraspStateEstimator(InputNode):
    """Computes `grasp_state` of a gripper with two fingers from the `force_field` of both.

    Two forces are a pair if their stamps differ by no more than `slop` and about half a period.
    tf must know both gel frames in `frame`; its newest transforms are used.  Without a pair for
    `timeout`, or without a transform, all is NaN and flags say why; a last value is never repeated.

    `supported_weight` is what the fingers carry against gravity while it is steady for a second.
    That is the weight of the object only if it touches nothing else.

    Friction is measured while something slides, and kept until a finger has lost contact.
    `grasp_markers` shows grip, load and margin, and is made only while somebody subscribes.
    """

    default_name = "grasp_state"

    def _set_up(self) -> None:
        self._given = StageParameters(self, GraspParameters(), self._use)
        self._poses = FramePoses(self)
        self._pairs, self._estimator = StampPairs(), GraspEstimator()
        self._state = self.add_result(GraspStateMsg, "grasp_state", grasp_state_to_msg)
        self._markers = self.add_publisher(MarkerArray, "grasp_markers")
        self._trouble = ""
        for side in OTHER:
            call = partial(self._on_force, side)
            self.add_input(ForceFieldMsg, f"{side}/force_field", call, force_field_from_msg)
        # It is reset by each pair.
        self._guard = self.create_steady_timer(self._given.value.timeout, self._on_timeout)

    def _use(self, parameters: GraspParameters) -> None:
        self._guard.timer_period_ns = round(parameters.timeout * NS_PER_S)
        self._guard.reset()

    def _start_again(self, _topic: str) -> None:
        self._pairs.forget()
        self._estimator.forget()

    def _on_force(self, side: str, field: ForceField, header: Header) -> None:
        slop_ns = self._given.value.slop * NS_PER_S
        pair = self._pairs.add(side, Felt(field, header), slop_ns)
        if pair is not None:
            self._guard.reset()
            newest = max(pair.values(), key=lambda felt: felt.stamp_ns)
            self._publish(self._state_of(pair, newest.stamp_ns), newest.header.stamp)

    def _state_of(self, pair: dict[str, Felt], newest_ns: int) -> GraspState:
        given = self._given.value
        fingers = {}
        for side, felt in pair.items():
            pose = self._poses.find(given.frame, felt.header.frame_id)
            if pose is None:
                self._trouble = f"no transform from {felt.header.frame_id} to {given.frame}"
                return GraspState(flags=felt.field.flags | GraspFlag.NO_TRANSFORM)
            fingers[side] = Finger(felt.field, pose)
        self._trouble = ""
        pose = self._poses.find(given.frame, given.up_frame) if given.up_frame else None
        up = None if pose is None else pose[:3, 2]
        left, right = fingers[LEFT], fingers[RIGHT]
        return self._estimator.update(left, right, newest_ns, up, given.friction)

    def _on_timeout(self) -> None:
        self._trouble = f"no pair of forces for {self._given.value.timeout:g} s"
        self._estimator.forget()
        self._publish(GraspState(flags=GraspFlag.STALE), self.get_clock().now().to_msg())

    def _publish(self, state: GraspState, stamp: Time) -> None:
        given = self._given.value
        header = Header(stamp=stamp, frame_id=given.frame)
        self._state.publish(state, header)
        self.frame_out(header)
        if self._markers.get_subscription_count():
            drawn = grasp_markers(state, given.force_gain)
            self._markers.publish(rviz.marker_array_bytes(drawn, header, MARKER_LIFETIME_S))

    def _update_diagnostics(self) -> None:
        self.diagnostics.note = Finding(
            Severity.ERROR if self._trouble else Severity.OK, self._trouble
        )


def main() -> int:
    """Entry point of `ros2 run cmp_tactile_processing grasp_state`."""
    return run_node(GraspStateEstimator)


if __name__ == "__main__":
    sys.exit(main())
