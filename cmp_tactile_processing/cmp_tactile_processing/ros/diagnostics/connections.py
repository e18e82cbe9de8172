"""Ends of a node's topics that are not connected, as the graph shows.

rclpy's events would report the same, without the other node's name, but each costs time whenever
the executor waits, and none says that it is over.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSCompatibility, qos_check_compatible

from cmp_tactile_processing.image.compressed import COMPRESSED

# Of ROS itself.
OTHERS = ("/rosout", "/parameter_events", "/clock")
# As rmw calls a node that it does not know yet.
UNKNOWN_NAME = "_NODE_NAME_UNKNOWN_"


def unconnected(node: Node) -> list[str]:
    """Why ends of other nodes get nothing from this one, or give it nothing: a text for each.

    Where the graph has as many ends of a topic as are connected, nobody looks any closer.
    """
    publishers, subscriptions = list(node.publishers), list(node.subscriptions)
    topics = {
        end.topic_name
        for end in subscriptions
        if node.count_publishers(end.topic_name) > end.get_publisher_count()
    } | {
        end.topic_name
        for end in publishers
        if node.count_subscribers(end.topic_name) > end.get_subscription_count()
    }
    return [text for topic in sorted(topics - {*OTHERS}) for text in _reasons(node, topic)]


def _reasons(node: Node, topic: str) -> Iterator[str]:
    own = node.get_fully_qualified_name()
    publishers = node.get_publishers_info_by_topic(topic)
    for publisher, subscription in product(publishers, node.get_subscriptions_info_by_topic(topic)):
        names = _full_name(publisher), _full_name(subscription)
        if own in names and (reason := _reason(publisher, subscription)):
            yield f"{topic}: no message from {names[0]} reaches {names[1]}: {reason}"


def _reason(publisher: Any, subscription: Any) -> str:
    if publisher.topic_type != subscription.topic_type:
        return f"found type {publisher.topic_type}, expected {subscription.topic_type}"
    verdict, reason = qos_check_compatible(publisher.qos_profile, subscription.qos_profile)
    return reason.replace("ERROR: ", "").strip("; ") if verdict == QoSCompatibility.ERROR else ""


def mixed(node: Node, topic: str) -> str:
    """That publishers of a topic take turns, with their names; empty once there is only one."""
    names = sorted(map(_full_name, node.get_publishers_info_by_topic(topic)))
    if len(names) < 2:
        return ""
    return f"{topic}: the messages of {' and '.join(names)} are mixed; end all of them but one"


def _full_name(end: Any) -> str:
    if end.node_name == UNKNOWN_NAME:
        return "a node without a name"
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"


def unpublished(node: Node) -> list[str]:
    """Topics that a node subscribes to and that nobody publishes.

    Each with the topic of the same image in another transport, where that is published.
    """
    topics = {end.topic_name for end in node.subscriptions} - {*OTHERS}
    return sorted(
        topic + other_transport(node, topic) for topic in topics if not node.count_publishers(topic)
    )


def other_transport(node: Node, topic: str) -> str:
    """The topic of the same image, raw or compressed, with its type; empty for none."""
    base = topic.removesuffix(COMPRESSED)
    other = base if topic != base else base + COMPRESSED
    kinds = {item.topic_type for item in node.get_publishers_info_by_topic(other)}
    return f" (found {other}, {', '.join(sorted(kinds))})" if kinds else ""
