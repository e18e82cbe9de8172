"""Problems of the ROS graph: ends of topics that cannot be connected, and names in use twice.

Connections are looked up in the graph once in a while.  The middleware's events would report the
same a little sooner, but each costs time whenever the executor waits, and none says which node is
meant.

ROS lets two nodes have one name.  Two sensors of one name mix their frames, and both answer one
another's services.  The graph shows that there are two, but not where: that is in what each reports
on /diagnostics.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

from cmp_tactile_processing.image.compressed import COMPRESSED

# Of ROS itself.
OTHERS = ("/rosout", "/parameter_events")
CLOCK = "/clock"
# As rmw calls a node that it does not know yet, and how it is reported.
UNKNOWN_NAME = "_NODE_NAME_UNKNOWN_"
UNNAMED = "a node without a name"
PATIENCE_S = 2.0
INFINITE_NS = 2**63 - 1


class ConnectionWatch:
    """Watches all publishers and subscriptions of a node; `warn` is called once for each trouble.

    problems: what is wrong now, by the topic, the kind of trouble, and the other node.
    """

    def __init__(self, node: Node, warn: Callable[[str], None]) -> None:
        self._node, self._warn = node, warn
        self.problems: dict[tuple[str, str, str], str] = {}
        self._unnamed: dict[tuple[str, str, str], float] = {}

    def check(self) -> None:
        """Ask the graph; what is new is warned of, and what is gone is no longer reported."""
        found = dict(self._found())
        # The name of who is new comes a moment after its end, and never without ROS.
        now = time.monotonic()
        unnamed = {key for key in found if key[2] == UNNAMED}
        self._unnamed = {key: self._unnamed.get(key, now) for key in unnamed}
        for key in unnamed:
            if now - self._unnamed[key] < PATIENCE_S:
                del found[key]
        for key, text in found.items():
            if key not in self.problems:
                self._warn(text)
        self.problems = found

    def texts(self) -> list[str]:
        """What is wrong now, one text of each trouble."""
        return list(self.problems.values())

    def unpublished(self) -> list[str]:
        """Topics that are subscribed to and that nobody publishes.

        Each with the topic of the same image in another transport, where that is published.
        """
        topics = {end.topic_name for end in self._node.subscriptions} - {*OTHERS, CLOCK}
        return sorted(
            topic + other_transport(self._node, topic)
            for topic in topics
            if not self._node.count_publishers(topic)
        )

    def _found(self) -> Iterator[tuple[tuple[str, str, str], str]]:
        for end in self._node.subscriptions:
            if end.topic_name not in OTHERS:
                others = self._node.get_publishers_info_by_topic(end.topic_name)
                yield from _troubles(end, others, _subscription_trouble)
        for end in self._node.publishers:
            if end.topic_name not in OTHERS:
                others = self._node.get_subscriptions_info_by_topic(end.topic_name)
                yield from _troubles(end, others, _publisher_trouble)


def other_transport(node: Node, topic: str) -> str:
    """The topic of the same image, raw or compressed, with its type; empty for none."""
    base = topic.removesuffix(COMPRESSED)
    other = base if topic != base else base + COMPRESSED
    kinds = {item.topic_type for item in node.get_publishers_info_by_topic(other)}
    return f" (there is {other}, {', '.join(sorted(kinds))})" if kinds else ""


def _troubles(
    end: Any, others: list[Any], trouble: Callable[[Any, Any, str], tuple[str, str]]
) -> Iterator[tuple[tuple[str, str, str], str]]:
    topic, own_type = end.topic_name, _type_name(end.msg_type)
    for other in others:
        name = _full_name(other)
        if other.topic_type != own_type:
            text = f"{topic}: {name} has type {other.topic_type}, expected {own_type}"
            yield (topic, "type", name), f"{text}; they are not connected"
            continue
        policy, text = trouble(end, other, name)
        if policy:
            yield (topic, policy, name), text


def _subscription_trouble(end: Any, other: Any, name: str) -> tuple[str, str]:
    policy = _incompatible(other.qos_profile, end.qos_profile)
    if not policy:
        return "", ""
    offered, wanted = _words(other.qos_profile, policy), _words(end.qos_profile, policy)
    return policy, (
        f"{end.topic_name}: nothing comes from {name}, which offers {policy} "
        f"{offered}, expected {wanted}; set {_remedy(end, policy, offered, 'subscription')}, "
        f"or {policy} {wanted} there"
    )


def _publisher_trouble(end: Any, other: Any, name: str) -> tuple[str, str]:
    policy = _incompatible(end.qos_profile, other.qos_profile)
    if not policy:
        return "", ""
    offered, wanted = _words(end.qos_profile, policy), _words(other.qos_profile, policy)
    return policy, (
        f"{end.topic_name}: {name} gets nothing, as it asks for {policy} {wanted}, "
        f"and {offered} is offered; set {policy} {offered} there"
    )


def _remedy(end: Any, policy: str, value: str, side: str) -> str:
    if policy == "reliability":
        return f"qos_overrides.{end.topic_name}.{side}.reliability: {value} here"
    return f"{policy} {value} here"


def _incompatible(publisher: QoSProfile, subscription: QoSProfile) -> str:
    """The first policy that keeps them apart, empty where none does.

    rclpy's qos_check_compatible takes the infinite durations of the graph for durations.
    """
    reliabilities = publisher.reliability, subscription.reliability
    if reliabilities == (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE):
        return "reliability"
    durabilities = publisher.durability, subscription.durability
    if durabilities == (DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL):
        return "durability"
    kinds = publisher.liveliness, subscription.liveliness
    if kinds == (LivelinessPolicy.AUTOMATIC, LivelinessPolicy.MANUAL_BY_TOPIC):
        return "liveliness"
    for policy in ("deadline", "liveliness_lease_duration"):
        if _duration_ns(publisher, policy) > _duration_ns(subscription, policy):
            return policy
    return ""


def _duration_ns(profile: QoSProfile, policy: str) -> int:
    """0 is how ROS says that there is no limit."""
    return int(getattr(profile, policy).nanoseconds) or INFINITE_NS


def _words(profile: QoSProfile, policy: str) -> str:
    value = getattr(profile, policy, "")
    if hasattr(value, "nanoseconds"):
        limit_ns = _duration_ns(profile, policy)
        return "without limit" if limit_ns == INFINITE_NS else f"{limit_ns * 1e-9:g} s"
    return str(getattr(value, "name", value)).lower()


def _full_name(end: Any) -> str:
    if end.node_name == UNKNOWN_NAME:
        return UNNAMED
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"


def _type_name(interface: type) -> str:
    package, folder, *_ = interface.__module__.split(".")
    return f"{package}/{folder}/{interface.__name__}"


PROCESS = "process"
"""Key of a status with the process of its node."""

QUEUE = 100
POLL_S = 0.1
DISCOVERY_S = 1.0
"""Within which a new node mostly knows those of running processes.

Fast DDS sometimes takes until the next of its announcements, 3 s apart.  Waiting as long would make
each start slower; whom this misses, NameWatch reports soon after.
"""

# Within which a node that runs reports at least twice.
LISTEN_S = 2.5
# As long as what was heard counts for other names, which are mostly of the same graph.
HEARD_S = 10.0


def this_process() -> str:
    """Number of this process, and its machine."""
    return f"{os.getpid()} on {socket.gethostname()}"


def times_named(node: Node, full_name: str) -> int:
    """How many nodes of the graph have this full name, also such that were killed a moment ago."""
    names = node.get_node_names_and_namespaces()
    return sum(f"{space.rstrip('/')}/{name}" == full_name for name, space in names)


def process_of(message: Any, full_name: str) -> str:
    """Where else than here a node of this name reports from; empty where it does not."""
    for status in message.status:
        if f"/{status.name}" == full_name:
            for pair in status.values:
                if pair.key == PROCESS and pair.value != this_process():
                    return str(pair.value)
    return ""


class NamesInUse:
    """Knows the processes of running nodes, before others of the same names are started."""

    def __init__(self, node: Node, discovery_s: float) -> None:
        """node: sees the graph.  discovery_s: how long from now on until it knows all, s."""
        self._node = node
        self._discovered = time.monotonic() + discovery_s
        self._one_at_a_time = threading.Lock()
        self._reports: list[DiagnosticArray] = []
        self._heard_until = -HEARD_S

    def process_of(self, full_name: str, is_stopped: Callable[[], bool]) -> str:
        """Where another process runs a node of this name; empty where none does.

        Waits for the graph to be known, and where it has the name, for a report: the graph keeps
        the nodes of a process that was killed for some seconds.  is_stopped: ends all waiting.
        """
        with self._one_at_a_time:
            while time.monotonic() < self._discovered and not is_stopped():
                time.sleep(POLL_S)
            if is_stopped() or not times_named(self._node, full_name):
                return ""
            kept = time.monotonic() <= self._heard_until + HEARD_S
            if not kept or self._heard(full_name):
                # What was heard before may have ended since.
                self._listen(full_name, is_stopped)
            return self._heard(full_name)

    def _heard(self, full_name: str) -> str:
        return next(filter(None, (process_of(item, full_name) for item in self._reports)), "")

    def _listen(self, full_name: str, is_stopped: Callable[[], bool]) -> None:
        """Until the name is heard or gone, or all that run must have been heard."""
        self._reports.clear()
        # Of its own: nobody else is to wait, nor to be woken by reports later.
        node = Node(
            f"_names_in_use_{os.getpid()}",
            context=self._node.context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        executor = SingleThreadedExecutor(context=self._node.context)
        executor.add_node(node)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._reports.append, QUEUE)
        until = time.monotonic() + LISTEN_S
        try:
            while not self._heard(full_name) and times_named(self._node, full_name):
                if is_stopped():
                    break
                if time.monotonic() > until:
                    self._heard_until = until
                    break
                with suppress(ExternalShutdownException):  # a signal ends all meanwhile
                    executor.spin_once(POLL_S)
        finally:
            executor.shutdown()
            node.destroy_node()


class NameWatch:
    """Whether the name of a node is its own; `report` is called once for each other process."""

    def __init__(self, node: Node, report: Callable[[str], None]) -> None:
        self._node, self._report = node, report
        self._reports: Any = None
        self._reported: set[str] = set()
        self._problem = ""

    def check(self) -> str:
        """What is wrong, in one line; empty where the name is its own."""
        if times_named(self._node, self._node.get_fully_qualified_name()) < 2:
            self._stop()
        elif self._reports is None:
            self._reports = self._node.create_subscription(
                DiagnosticArray, "/diagnostics", self._on_report, QUEUE
            )
        return self._problem

    def _stop(self) -> None:
        self._problem = ""
        self._reported.clear()
        if self._reports is not None:
            self._node.destroy_subscription(self._reports)
            self._reports = None

    def _on_report(self, message: Any) -> None:
        name = self._node.get_fully_qualified_name()
        process = process_of(message, name)
        if process:
            self._problem = (
                f"{name} runs in process {process}, too, beside process {this_process()} here: "
                "two sensors of one name mix their frames; end one or give it another namespace"
            )
        if process and process not in self._reported:
            self._reported.add(process)
            self._report(self._problem)
