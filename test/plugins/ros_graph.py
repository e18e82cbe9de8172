"""A ROS graph for a test: nodes under test, and a node of the test."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Mapping
from typing import Any

from waiting import TIMEOUT_S, wait_until

_numbers = itertools.count()


class Reports:
    """What one node reports in /diagnostics from now on."""

    def __init__(self, graph: RosGraph, node: str) -> None:
        from diagnostic_msgs.msg import DiagnosticArray

        self._name = f"{graph.namespace}/{node}".lstrip("/")
        self._received = graph.listen(DiagnosticArray, "/diagnostics")

    @property
    def all(self) -> list[Any]:
        """Every status of the node, in order."""
        statuses = (status for report in self._received for status in report.status)
        return [status for status in statuses if status.name == self._name]

    @property
    def last(self) -> Any:
        """The newest status, a stale one before the first."""
        from diagnostic_msgs.msg import DiagnosticStatus

        none = DiagnosticStatus(level=DiagnosticStatus.STALE, message="no report")
        return [none, *self.all][-1]

    @property
    def values(self) -> dict[str, str]:
        """Its figures by key."""
        return {item.key: item.value for item in self.last.values}


class RosGraph:
    """Nodes under test and one node of the test, in a context and a namespace of their own.

    Nothing runs outside `wait`, so a test sees the same order of events each time.
    """

    def __init__(self) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        self.context = rclpy.Context()
        self.context.init()
        self.namespace = f"/test_{os.getpid()}_{next(_numbers)}"
        self.executor = SingleThreadedExecutor(context=self.context)
        self._nodes: list[Any] = []
        self.node = self._add(
            rclpy.create_node("tester", context=self.context, namespace=self.namespace)
        )

    def _add(self, node: Any) -> Any:
        self._nodes.append(node)
        self.executor.add_node(node)
        return node

    def start(self, node_class: Callable[..., Any], name: str = "", **parameters: Any) -> Any:
        """A node under test, with the sample rig unless given otherwise."""
        from rclpy.parameter import Parameter

        parameters.setdefault("sensor_description", "sample_rig")
        remap = ["--ros-args", "-r", f"__node:={name}"] if name else []
        return self._add(
            node_class(
                context=self.context,
                namespace=self.namespace,
                cli_args=remap,
                use_global_arguments=False,
                parameter_overrides=[Parameter(k, value=v) for k, v in parameters.items()],
            )
        )

    def listen(
        self, message_type: type, topic: str, *, latched: bool = False, **qos: Any
    ) -> list[Any]:
        """The list that messages of the topic are appended to."""
        from rclpy.qos import DurabilityPolicy, QoSProfile

        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        profile = QoSProfile(**{"depth": 100, "durability": durability, **qos})
        received: list[Any] = []
        self.node.create_subscription(message_type, topic, received.append, profile)
        return received

    def reports(self, node: str) -> Reports:
        """What a node of the graph reports."""
        return Reports(self, node)

    def publisher(self, message_type: type, topic: str, subscribers: int = 1) -> Any:
        """A publisher that so many subscribers have found."""
        publisher = self.node.create_publisher(message_type, topic, 100)
        self.wait(
            lambda: publisher.get_subscription_count() >= subscribers, f"subscribers of {topic}"
        )
        return publisher

    def wait_subscribed(self, node: Any, *topics: str) -> None:
        """Until the node's publishers of these topics know of a subscriber."""
        for publisher in node.publishers:
            if publisher.topic_name in [f"{self.namespace}/{topic}" for topic in topics]:
                self.wait(publisher.get_subscription_count, f"{publisher.topic_name} subscribed")

    def wait(self, condition: Callable[[], Any], what: str, timeout_s: float = TIMEOUT_S) -> None:
        """Run the nodes until the condition holds; the test fails where it never does."""
        wait_until(condition, what, timeout_s, self._spin)

    def run(self, duration_s: float) -> None:
        """Run the nodes for a while, to see that something does not happen."""
        end = time.monotonic() + duration_s
        while time.monotonic() < end:
            self._spin()

    def _spin(self) -> None:
        self.executor.spin_once(timeout_sec=0.02)

    def call(self, service_type: Any, name: str, request: Any, timeout_s: float = TIMEOUT_S) -> Any:
        """The answer of a service."""
        future = self.call_later(service_type, name, request, timeout_s)
        self.wait(future.done, f"the answer of {name}", timeout_s)
        return future.result()

    def call_later(
        self, service_type: Any, name: str, request: Any, timeout_s: float = TIMEOUT_S
    ) -> Any:
        """The future of a service's answer."""
        client = self.node.create_client(service_type, name)
        self.wait(client.service_is_ready, f"service {name}", timeout_s)
        return client.call_async(request)

    def set_parameters(
        self, node: str, values: Mapping[str, Any], *, together: bool = False
    ) -> Any:
        """The answers to changes of a node's parameters, or that to all of them together."""
        from rcl_interfaces.srv import SetParameters, SetParametersAtomically
        from rclpy.parameter import Parameter

        changes = [
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
        ]
        service = f"{self.namespace}/{node}/set_parameters"
        if not together:
            request = SetParameters.Request(parameters=changes)
            return self.call(SetParameters, service, request).results
        request = SetParametersAtomically.Request(parameters=changes)
        return self.call(SetParametersAtomically, f"{service}_atomically", request).result

    def close(self) -> None:
        """Destroy what was made."""
        self.executor.shutdown()
        for node in reversed(self._nodes):
            node.destroy_node()
        self.context.try_shutdown()
