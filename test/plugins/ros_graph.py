"""A ROS graph for a test: nodes under test, and a node of the test."""

import itertools
import os
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from waiting import TIMEOUT_S, wait_until

_numbers = itertools.count()


def header_at(stamp_ns: int, frame_id: str = "camera") -> Any:
    """A std_msgs/Header."""
    from std_msgs.msg import Header

    header = Header(frame_id=frame_id)
    header.stamp.sec, header.stamp.nanosec = divmod(stamp_ns, 10**9)
    return header


def stamps_of(messages: Iterable[Any]) -> list[int]:
    """Stamps of messages with a header, ns."""
    stamps = (message.header.stamp for message in messages)
    return [stamp.sec * 10**9 + stamp.nanosec for stamp in stamps]


class Statuses:
    """What a node says of itself."""

    def __init__(self, find_all: Callable[[], list[Any]]) -> None:
        self._find_all = find_all

    @property
    def all(self) -> list[Any]:
        """Every status of the node, in order."""
        return self._find_all()

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

    @property
    def state(self) -> str:
        """Its figure of that name, empty before the first status."""
        return self.values.get("state", "")


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

    def reports(self, node: str) -> Statuses:
        """What a node of the graph reports in /diagnostics from now on."""
        from diagnostic_msgs.msg import DiagnosticArray

        name = f"{self.namespace}/{node}".lstrip("/")
        received = self.listen(DiagnosticArray, "/diagnostics")
        return Statuses(
            lambda: [item for report in received for item in report.status if item.name == name]
        )

    def statuses(self, node: str) -> Statuses:
        """What a node of the driver publishes as its `~/status`, which is latched."""
        from diagnostic_msgs.msg import DiagnosticStatus

        received = self.listen(DiagnosticStatus, f"{node}/status", latched=True, depth=1)
        return Statuses(lambda: received)

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

    def lifecycle_state(self, node: str) -> str:
        """The state of a lifecycle node."""
        from lifecycle_msgs.srv import GetState

        return self.call(GetState, f"{node}/get_state", GetState.Request()).current_state.label

    def change_state(self, node: str, transition: int) -> bool:
        """Whether a lifecycle node has made a transition."""
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState

        request = ChangeState.Request(transition=Transition(id=transition))
        return self.call(ChangeState, f"{node}/change_state", request).success

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
