"""What every node of ours that reports on /diagnostics has: thresholds, connections, reports."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from cmp_tactile_processing.ros.diagnostics.connection_watch import ConnectionWatch
from cmp_tactile_processing.ros.diagnostics.hysteresis import Finding
from cmp_tactile_processing.ros.diagnostics.name_watch import NameWatch
from cmp_tactile_processing.ros.diagnostics.parameters import SECTION, DiagnosticsParameters
from cmp_tactile_processing.ros.diagnostics.reporter import DiagnosticsReporter
from cmp_tactile_processing.ros.intra_process_node import IntraProcessNode
from cmp_tactile_processing.ros.parameter_refusal import TellingNode, unknown_overrides
from cmp_tactile_processing.ros.stage_parameters import StageParameters

__all__ = ["SERVICE_QOS", "ReportingNode"]


SERVICE_QOS = QoSProfile(depth=1000)
"""As that of parameters: of more requests at once than the 10 of ROS's default the rest is lost,
and whoever asked waits for ever."""


class ReportingNode(TellingNode, IntraProcessNode, ABC):
    """Stands before Node or LifecycleNode among the bases; calls `start_reporting` when set up.

    thresholds: of its figures, parameters `diagnostics.*` that may change while it runs.
    connections: its ends that cannot be connected.  That takes the place of rclpy's handlers of
    the same events, each of which costs time whenever the executor waits.
    """

    thresholds = DiagnosticsParameters()
    connections: ConnectionWatch
    reporter: DiagnosticsReporter
    _name_watch: NameWatch

    @abstractmethod
    def _status(self) -> DiagnosticStatus:
        """How the node is, with the figures since the last call."""

    def start_reporting(self, also_to: Sequence[Publisher[Any]] = ()) -> None:
        """Declare the thresholds and report once a second from now on.

        also_to: publishers that get every status too.
        """
        limits = StageParameters(self, DiagnosticsParameters(), self._use_thresholds, SECTION)
        self._use_thresholds(limits.value)
        self.connections = ConnectionWatch(self, self.get_logger().warning)
        self._name_watch = NameWatch(self, self.get_logger().error)
        self.reporter = DiagnosticsReporter(self, self._status, also_to)

    def warn_of_unknown_parameters(self, *but: str) -> None:
        """Of those given at the start that the node has not, by now; but: beginnings of names."""
        for text in unknown_overrides(self):
            if not text.startswith(but):
                self.get_logger().warning(f"{text} (given at the start, without effect)")

    def connection_findings(self) -> list[Finding]:
        """Ends of the node's topics that cannot be connected, looked up now."""
        self.connections.check()
        return [Finding(DiagnosticStatus.WARN, text) for text in self.connections.texts()]

    def name_findings(self) -> list[Finding]:
        """Another process with a node of this name, looked up now.

        For nodes that publish frames, so that one line reports two sensors of one name.
        """
        return [Finding(DiagnosticStatus.ERROR, self._name_watch.check())]

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **kwargs: Any) -> Any:
        """As Node's."""
        if kwargs.get("event_callbacks") is None:
            kwargs["event_callbacks"] = PublisherEventCallbacks(use_default_callbacks=False)
        return super().create_publisher(msg_type, topic, qos_profile, **kwargs)

    def create_subscription(
        self,
        msg_type: Any,
        topic: str,
        callback: Callable[..., Any],
        qos_profile: Any,
        **kwargs: Any,
    ) -> Any:
        """As Node's."""
        if kwargs.get("event_callbacks") is None:
            kwargs["event_callbacks"] = SubscriptionEventCallbacks(use_default_callbacks=False)
        return super().create_subscription(msg_type, topic, callback, qos_profile, **kwargs)

    def create_service(self, *args: Any, **kwargs: Any) -> Any:
        """As Node's."""
        kwargs.setdefault("qos_profile", SERVICE_QOS)
        return super().create_service(*args, **kwargs)

    def _use_thresholds(self, thresholds: DiagnosticsParameters) -> None:
        self.thresholds = thresholds
