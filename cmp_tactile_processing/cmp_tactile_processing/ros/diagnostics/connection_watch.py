"""Finds who is on a topic of a node, but cannot be connected: other quality of service, other type.

Asked of the graph once in a while.  The middleware's events would tell the same a little sooner,
but each costs time whenever the executor waits, and none tells who is meant.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

__all__ = ["ConnectionWatch"]

# Of ROS itself.
OTHERS = ("/rosout", "/parameter_events")
CLOCK = "/clock"
# As rmw calls a node that it does not know yet, and what it is told as.
UNKNOWN_NAME = "_NODE_NAME_UNKNOWN_"
UNNAMED = "a node without a name"
PATIENCE_S = 2.0
INFINITE_NS = 2**63 - 1


class ConnectionWatch:
    """Looks after all publishers and subscriptions of a node; `warn` is told once of each trouble.

    problems: what is wrong now, by the topic, the kind of trouble, and the other node.
    """

    def __init__(self, node: Node, warn: Callable[[str], None]) -> None:
        self._node, self._warn = node, warn
        self.problems: dict[tuple[str, str, str], str] = {}
        self._unnamed: dict[tuple[str, str, str], float] = {}

    def check(self) -> None:
        """Ask the graph; what is new is warned of, and what is gone is told no more."""
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
        """Topics that are subscribed to, and that nobody publishes."""
        topics = {end.topic_name for end in self._node.subscriptions} - {*OTHERS, CLOCK}
        return sorted(topic for topic in topics if not self._node.count_publishers(topic))

    def _found(self) -> Iterator[tuple[tuple[str, str, str], str]]:
        for end in self._node.subscriptions:
            if end.topic_name not in OTHERS:
                others = self._node.get_publishers_info_by_topic(end.topic_name)
                yield from _troubles(end, others, _subscription_trouble)
        for end in self._node.publishers:
            if end.topic_name not in OTHERS:
                others = self._node.get_subscriptions_info_by_topic(end.topic_name)
                yield from _troubles(end, others, _publisher_trouble)


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

    rclpy's qos_check_compatible takes the infinite durations that the graph tells for durations.
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
