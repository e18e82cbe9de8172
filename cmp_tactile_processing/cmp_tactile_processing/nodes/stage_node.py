"""What the nodes of all stages share: sensor, guarded callbacks, QoS, diagnostics."""

from __future__ import annotations

import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_msgs.msg import Header

from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.nodes.conversions import stamp_ns
from cmp_tactile_processing.nodes.stage_diagnostics import StageDiagnostics
from cmp_tactile_processing.nodes.stage_parameters import declare_checked
from cmp_tactile_processing.sensor_library import (
    DEFAULT_SENSOR,
    SENSOR_NAME_HELP,
    load_sensor,
)

__all__ = ["StageNode"]

RESULT_DEPTH = 10
IMAGE_DEPTH = 5
# A second of frames at 20 Hz: a stage may be slow for a while before it loses one.
INPUT_DEPTH = 20
WARNING_PERIOD_S = 5.0
DIAGNOSTICS_PERIOD_S = 1.0


class StageNode(Node, ABC):
    """A node around one stage; subclasses build stage, publishers and subscriptions in `_set_up`.

    Keyword arguments are those of rclpy.node.Node.  Raises CmpTactileError, with the node
    destroyed, where sensor description or parameters cannot be used.
    """

    def __init__(self, default_name: str, **node_kwargs: Any) -> None:
        super().__init__(default_name, **node_kwargs)
        self._warned: dict[str, tuple[float, int]] = {}
        try:
            self.diagnostics = StageDiagnostics()
            self.sensor = load_sensor(
                self.declare_fixed(
                    "sensor_description",
                    DEFAULT_SENSOR,
                    "file of the sensor description, or name of a packaged one",
                ),
                self.declare_fixed("sensor_name", "", SENSOR_NAME_HELP),
            )
            self._set_up()
            self._start_diagnostics()
        except BaseException:
            self.destroy_node()
            raise

    @abstractmethod
    def _set_up(self) -> None:
        """Declare parameters, build the stage, create publishers and subscriptions."""

    def declare_fixed(
        self, name: str, default: Any, description: str, constraints: str = ""
    ) -> Any:
        """Declare a read-only parameter and return its value."""
        descriptor = ParameterDescriptor(
            description=description, additional_constraints=constraints, read_only=True
        )
        return declare_checked(self, name, default, descriptor)

    def add_publisher(
        self, message_type: type, topic: str, depth: int = RESULT_DEPTH, *, latched: bool = False
    ) -> Publisher[Any]:
        """A reliable publisher; latched: late subscribers get the last `depth` messages."""
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
        return self.create_publisher(
            message_type,
            topic,
            qos,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def add_input(
        self,
        message_type: type,
        topic: str,
        callback: Callable[[Any], None],
        *,
        reliable: bool = True,
    ) -> None:
        """Subscribe; whatever a message causes is logged and counted, never raised."""
        policy = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        name = self.resolve_topic_name(topic)

        def guarded(message: Any) -> None:
            self.diagnostics.frame_in()
            self._run_guarded(name, callback, message)

        self.create_subscription(
            message_type,
            topic,
            guarded,
            QoSProfile(depth=INPUT_DEPTH, reliability=policy),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def declare_reliable_input(self) -> bool:
        """The parameter that tells whether images are subscribed to reliably."""
        return bool(
            self.declare_fixed(
                "reliable_input",
                True,
                "subscribe to images reliably, which a best-effort publisher does not match",
            )
        )

    def frame_out(self, header: Header) -> None:
        """Count a published result whose camera frame had the stamp of that header."""
        now = self.get_clock().now().nanoseconds
        self.diagnostics.frame_out((now - stamp_ns(header.stamp)) * 1e-9)

    def warn(self, topic: str, text: str) -> None:
        """Log a warning about a topic's messages, once in five seconds at most."""
        now = time.monotonic()
        last, silent = self._warned.get(topic, (-WARNING_PERIOD_S, 0))
        if now - last < WARNING_PERIOD_S:
            self._warned[topic] = (last, silent + 1)
            return
        self._warned[topic] = (now, 0)
        more = f" ({silent} more bad messages since the last warning)" if silent else ""
        self.get_logger().warning(f"{topic}: {text}{more}")

    def _update_diagnostics(self) -> None:
        """Refresh `diagnostics.extra` before a report; for subclasses."""

    def _run_guarded(self, topic: str, callback: Callable[[Any], None], message: Any) -> None:
        try:
            callback(message)
        except CmpTactileError as error:
            self.diagnostics.bad_frame(f"{topic}: {error}")
            self.warn(topic, str(error))
        except Exception as error:  # noqa: BLE001  one frame must not end the node
            if not self.context.ok():
                return
            self.diagnostics.bad_frame(f"{topic}: {error!r}")
            self.get_logger().error(f"{topic}: unexpected error\n{traceback.format_exc()}")

    def _start_diagnostics(self) -> None:
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Steady: a paused simulation clock must not silence the diagnostics.
        self.create_timer(
            DIAGNOSTICS_PERIOD_S,
            self._publish_diagnostics,
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )

    def _publish_diagnostics(self) -> None:
        self._update_diagnostics()
        name = self.get_fully_qualified_name().lstrip("/")
        report = DiagnosticArray(status=[self.diagnostics.status(name, self.sensor.ros_name)])
        report.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics_publisher.publish(report)
