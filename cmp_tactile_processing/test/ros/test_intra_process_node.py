"""Messages handed over between nodes: which are theirs, and what is left to DDS."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from typing import Any

import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from waiting import wait_until

from cmp_tactile_processing.ros.intra_process import (
    Exchange,
    Inbox,
    IntraProcessNode,
    Member,
    Terms,
    joining,
)

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_numbers = itertools.count()


class Room:
    """Nodes that are members of one exchange, in a namespace of the test."""

    def __init__(self) -> None:
        self.context = rclpy.Context()
        self.context.init(args=[])
        self.namespace = f"/room_{os.getpid()}_{next(_numbers)}"
        self.exchange = Exchange()
        self.nodes: list[Node] = []

    def node(self, name: str, *bases: type) -> Any:
        """A node that takes part; bases: of its class."""
        kind = type("Sample", bases or (IntraProcessNode,), {})
        with joining(Member(self.exchange)):
            node = kind(name, context=self.context, namespace=self.namespace)
        self.nodes.append(node)
        return node


@pytest.fixture
def room() -> Iterator[Room]:
    room = Room()
    yield room
    for node in room.nodes:
        node.destroy_node()
    room.context.try_shutdown()


def test_a_publisher_is_known_beside_one_that_comes_at_the_same_moment(room, monkeypatch):
    """Taken for the other's, its own messages would come twice, and the other's never."""
    own, other = room.node("own"), rclpy.create_node("other", context=room.context)
    room.nodes.append(other)
    create = Node.create_publisher

    def both(node: Node, kind: type, topic: str, qos: Any, **options: Any) -> Any:
        create(other, kind, f"{room.namespace}/{topic}", qos)
        return create(node, kind, topic, qos, **options)

    monkeypatch.setattr(Node, "create_publisher", both)
    # Several, as one may be right by chance.
    for topic in ("a", "b", "c", "d", "e", "f"):
        outlet = own.create_publisher(String, topic, 1).outlet
        infos = own.get_publishers_info_by_topic(f"{room.namespace}/{topic}")
        names = {bytes(info.endpoint_gid): info.node_name for info in infos}
        assert len(names) == 2
        assert names[outlet.gid] == "own"


def test_a_coroutine_gets_messages_over_dds(room):
    """It goes on when the executor has time; by an inbox it would never begin."""
    talks, hears = room.node("talks"), room.node("hears")
    heard: list[str] = []

    async def hear(message: String) -> None:
        heard.append(message.data)

    hears.create_subscription(String, "text", hear, 10)
    publisher = talks.create_publisher(String, "text", 10)
    executor = SingleThreadedExecutor(context=room.context)
    executor.add_node(hears)
    wait_until(
        lambda: publisher.publish(String(data="a")) or heard,
        "a message",
        step=lambda: executor.spin_once(timeout_sec=0.1),
    )
    executor.shutdown()
    assert heard[0] == "a"


def test_what_a_lifecycle_publisher_latched_goes_with_it(room):
    node = room.node("camera", IntraProcessNode, LifecycleNode)
    publisher = node.create_lifecycle_publisher(String, "info", LATCHED)
    publisher.outlet.intra_process(String(data="old"))
    assert node.destroy_lifecycle_publisher(publisher)
    member = Member(room.exchange)
    inbox = Inbox(Terms(f"{room.namespace}/info", String, LATCHED), print, member.post)
    room.exchange.add_inbox(inbox)
    assert inbox.queued == 0
