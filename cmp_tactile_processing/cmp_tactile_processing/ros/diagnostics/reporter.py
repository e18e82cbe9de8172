"""Reports of a node on `/diagnostics`, once a second."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher

from cmp_tactile_processing.ros.diagnostics.name_watch import PROCESS, this_process

__all__ = ["DIAGNOSTICS_PERIOD_S", "DiagnosticsReporter", "status_message", "status_name"]

DIAGNOSTICS_PERIOD_S = 1.0


def status_name(node: Node) -> str:
    """Under which a node reports: its full name without the slash that it begins with."""
    return node.get_fully_qualified_name().lstrip("/")


def status_message(
    name: str, hardware_id: str, summary: tuple[bytes, str], values: Mapping[str, object]
) -> DiagnosticStatus:
    """A status; summary: level and message."""
    return DiagnosticStatus(
        level=summary[0],
        name=name,
        message=summary[1],
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
    )


class DiagnosticsReporter:
    """Publishes what `status` tells once a second, and at once by `publish`.

    also_to: publishers of DiagnosticStatus that get it too.
    """

    def __init__(
        self,
        node: Node,
        status: Callable[[], DiagnosticStatus],
        also_to: Sequence[Publisher[Any]] = (),
    ) -> None:
        self._node, self._status, self._also_to = node, status, also_to
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Steady: a paused simulation clock must not silence the diagnostics.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(DIAGNOSTICS_PERIOD_S, self.publish, clock=steady)

    def publish(self) -> None:
        """Report now."""
        status = self._status()
        status.values.append(KeyValue(key=PROCESS, value=this_process()))
        for publisher in self._also_to:
            publisher.publish(status)
        report = DiagnosticArray(status=[status])
        report.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(report)
