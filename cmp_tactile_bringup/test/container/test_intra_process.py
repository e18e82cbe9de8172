"""Components of one container hand messages over; who listens outside gets them over DDS."""

from __future__ import annotations

import itertools
import threading
from typing import Any

import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from cmp_tactile_processing.ros.intra_process import IntraProcessNode, inbox_of


class Source(IntraProcessNode):
    """Publishes when the test says so."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("source", **node_kwargs)
        self.plain = self.create_publisher(String, "text", 100)
        latched = QoSProfile(depth=2, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.latched = self.create_publisher(String, "latched", latched)


class Sink(IntraProcessNode):
    """Keeps what it gets."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("sink", **node_kwargs)
        self.received: list[String] = []
        self.latched: list[String] = []
        self.gate = threading.Event()
        self.gate.set()
        self.subscription = self.create_subscription(String, "text", self._on_text, 100)
        latched = QoSProfile(depth=2, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(String, "latched", self.latched.append, latched)

    def _on_text(self, message: String) -> None:
        self.gate.wait()
        self.received.append(message)


@pytest.fixture
def box(ros: Any, make_box: Any) -> Any:
    """A container whose components the test holds by name in `nodes`."""
    nodes: dict[str, Any] = {}

    def find(_package: str, plugin: str) -> Any:
        base = {"Source": Source, "Sink": Sink}[plugin.partition("::")[2]]

        class Held(base):  # type: ignore[misc, valid-type]
            def __init__(self, **node_kwargs: Any) -> None:
                super().__init__(**node_kwargs)
                nodes[self.get_name()] = self

        return Held

    box = make_box(find)
    box.nodes, box.run = nodes, ros.run
    return box


def _listen(box: Any, topic: str, **qos: Any) -> tuple[list[str], Any]:
    """What is heard outside of the container, and the subscription."""
    heard: list[str] = []
    profile = QoSProfile(**{"depth": 1000, **qos})
    subscription = box.node.create_subscription(
        String, topic, lambda message: heard.append(message.data), profile
    )
    return heard, subscription


def _publish(box: Any, *texts: str) -> list[String]:
    messages = [String(data=text) for text in texts]
    for message in messages:
        box.nodes["source"].plain.publish(message)
    return messages


def test_the_object_passes_and_dds_carries_nothing(box):
    box.load("Sink")
    box.load("Source")
    sent = _publish(box, *map(str, range(50)))
    sink = box.nodes["sink"]
    box.wait(lambda: len(sink.received) >= 50, "messages in the container")
    assert all(got is message for got, message in zip(sink.received, sent, strict=True))
    assert box.nodes["source"].plain.outlet.sent_over_dds == 0


def test_who_listens_outside_gets_each_message_and_nobody_inside_gets_one_twice(box):
    box.load("Sink")
    box.load("Source")
    sink, source = box.nodes["sink"], box.nodes["source"]
    _publish(box, *map(str, range(20)))
    heard, subscription = _listen(box, "text")
    box.wait(lambda: source.plain.get_subscription_count() == 2, "the listener outside")
    _publish(box, *map(str, range(20, 60)))
    box.wait(lambda: len(heard) >= 40, "messages outside")
    box.node.destroy_subscription(subscription)
    box.wait(lambda: source.plain.get_subscription_count() == 1, "the listener to be gone")
    _publish(box, *map(str, range(60, 80)))
    box.wait(lambda: len(sink.received) >= 80, "messages in the container")
    box.run(0.3)
    assert heard == [str(i) for i in range(20, 60)]
    assert [message.data for message in sink.received] == [str(i) for i in range(80)]
    assert source.plain.outlet.sent_over_dds == 40


def test_publishers_outside_are_heard_beside_those_inside(box):
    box.load("Sink")
    box.load("Source")
    sink = box.nodes["sink"]
    publisher = box.node.create_publisher(String, "text", 100)
    box.wait(lambda: publisher.get_subscription_count() == 1, "the sink")
    for i in range(10):
        publisher.publish(String(data=f"out {i}"))
        _publish(box, f"in {i}")
    box.wait(lambda: len(sink.received) >= 20, "all messages")
    box.run(0.2)
    texts = [message.data for message in sink.received]
    assert [text for text in texts if text[0] == "i"] == [f"in {i}" for i in range(10)]
    assert [text for text in texts if text[0] == "o"] == [f"out {i}" for i in range(10)]


def test_who_comes_late_gets_what_is_latched_once_inside_and_outside(box):
    box.load("Source")
    for text in ("a", "b", "c"):
        box.nodes["source"].latched.publish(String(data=text))
    box.load("Sink")
    heard, _ = _listen(box, "latched", durability=DurabilityPolicy.TRANSIENT_LOCAL)
    sink = box.nodes["sink"]
    box.wait(lambda: len(sink.latched) >= 2 and len(heard) >= 2, "what is latched")
    box.run(0.3)
    assert [message.data for message in sink.latched] == ["b", "c"]
    assert heard == ["b", "c"]


def test_a_component_may_ask_for_dds_alone(box):
    box.load("Sink", intra_process=False)
    box.load("Source")
    (sent,) = _publish(box, "a")
    sink = box.nodes["sink"]
    assert inbox_of(sink.subscription) is None
    box.wait(lambda: sink.received, "the message")
    assert sink.received[0] == sent
    assert sink.received[0] is not sent


def test_a_component_that_is_slow_drops_the_oldest_and_does_not_hold_up_the_others(box):
    box.load("Sink", "slow")
    box.load("Sink", "quick")
    box.load("Source")
    slow, quick = box.nodes["slow"], box.nodes["quick"]
    slow.gate.clear()
    _publish(box, *map(str, range(150)))
    box.wait(lambda: len(quick.received) >= 100, "the other component")
    inbox = inbox_of(slow.subscription)
    # One is under way, and 99 wait where all came before it was taken.
    box.wait(lambda: inbox.queued + inbox.dropped == 149, "a full queue")
    assert inbox.queued in (99, 100)
    slow.gate.set()
    box.wait(lambda: slow.received and slow.received[-1].data == "149", "the last message")
    assert inbox.dropped + len(slow.received) == 150
    assert [int(message.data) for message in slow.received][-99:] == list(range(51, 150))


def test_components_come_and_go_while_messages_flow(box):
    box.load("Source")
    box.load("Sink", "stays")
    stays, count, ending = box.nodes["stays"], itertools.count(), threading.Event()

    def feed() -> None:
        while not ending.wait(0.002):
            _publish(box, str(next(count)))

    feeder = threading.Thread(target=feed)
    feeder.start()
    try:
        for cycle in range(15):
            unique_id = box.load("Sink", f"guest_{cycle}")
            guest = box.nodes[f"guest_{cycle}"]
            box.wait(lambda guest=guest: guest.received, "messages for the guest")
            box.container.unload(unique_id)
            left = len(guest.received)
            numbers = [int(message.data) for message in guest.received]
            assert numbers == list(range(numbers[0], numbers[0] + left))
    finally:
        ending.set()
        feeder.join()
    total = next(count)
    box.wait(lambda: len(stays.received) == total, "all messages for who stayed")
    assert [int(message.data) for message in stays.received] == list(range(total))
    assert len(box.nodes["source"].plain.outlet.inboxes) == 1
