"""Intra-process messages between members of one exchange behaves as DDS would."""

from __future__ import annotations

import gc
import sys
import weakref

import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int32, String

from cmp_tactile_processing.ros.intra_process import (
    Exchange,
    Inbox,
    Member,
    Outlet,
    Result,
    Terms,
    fits_intra_process,
)

TOPIC = "/s/grid"
LATCHED = DurabilityPolicy.TRANSIENT_LOCAL


class Subscriber:
    """An inbox with messages that are delivered when the test says so."""

    def __init__(
        self,
        exchange: Exchange,
        message_type: type = String,
        *,
        takes_results: bool = False,
        **qos,
    ) -> None:
        self.member = Member(exchange)
        self.received: list = []
        self.inbox = Inbox(
            _terms(message_type, **qos),
            self.received.append,
            self.member.post,
            takes_results=takes_results,
        )
        exchange.add_inbox(self.inbox)

    def deliver(self) -> list:
        """All that was posted."""
        self.member.stop()
        while (inbox := self.member.next()) is not None:
            inbox.deliver()
        return self.received


def _terms(message_type: type = String, topic: str = TOPIC, **qos) -> Terms:
    return Terms(topic, message_type, QoSProfile(**{"depth": 10, **qos}))


def _outlet(exchange: Exchange, gid: bytes = b"", **qos) -> Outlet:
    outlet = Outlet(_terms(**qos), gid)
    exchange.add_outlet(outlet)
    return outlet


def _texts(outlet: Outlet, *texts: str) -> list[String]:
    messages = [String(data=text) for text in texts]
    for message in messages:
        outlet.intra_process(message)
    return messages


def test_the_object_itself_arrives_in_order():
    exchange = Exchange()
    outlet, first, second = _outlet(exchange), Subscriber(exchange), Subscriber(exchange)
    sent = _texts(outlet, "a", "b", "c")
    for received in (first.deliver(), second.deliver()):
        assert len(received) == 3
        assert all(x is y for x, y in zip(received, sent, strict=True))


def test_the_message_of_a_result_is_made_once_and_only_for_who_needs_one():
    exchange, made = Exchange(), []

    def to_msg(value: int, header: str) -> String:
        made.append(value)
        return String(data=f"{header} {value}")

    outlet, stage = _outlet(exchange), Subscriber(exchange, takes_results=True)
    outlet.intra_process(Result(7, "mm", to_msg))
    (result,) = stage.deliver()
    assert (result.value, result.header, made) == (7, "mm", [])
    others = [Subscriber(exchange) for _ in range(2)]
    outlet.intra_process(Result(8, "mm", to_msg))
    (first,), (second,) = (other.deliver() for other in others)
    assert first is second
    assert first.data == "mm 8"
    assert made == [8]


def test_a_full_queue_drops_the_oldest_and_counts():
    exchange = Exchange()
    outlet, slow = _outlet(exchange), Subscriber(exchange, depth=2)
    _texts(outlet, "a", "b", "c", "d")
    assert (slow.inbox.queued, slow.inbox.dropped) == (2, 2)
    assert [m.data for m in slow.deliver()] == ["c", "d"]
    assert slow.inbox.queued == 0


def test_keep_all_drops_nothing():
    exchange = Exchange()
    outlet = _outlet(exchange)
    slow = Subscriber(exchange, depth=0, history=HistoryPolicy.KEEP_ALL)
    _texts(outlet, *map(str, range(100)))
    assert [m.data for m in slow.deliver()] == [str(i) for i in range(100)]


@pytest.mark.parametrize(
    ("offered", "requested", "expected"),
    [(LATCHED, LATCHED, ["b", "c", "d"]), (LATCHED, DurabilityPolicy.VOLATILE, ["d"])],
)
def test_who_comes_late_gets_what_is_latched(offered, requested, expected):
    exchange = Exchange()
    outlet = _outlet(exchange, depth=2, durability=offered)
    _texts(outlet, "a", "b", "c")
    late = Subscriber(exchange, durability=requested)
    _texts(outlet, "d")
    assert [m.data for m in late.deliver()] == expected


@pytest.mark.parametrize(
    ("offered", "requested"),
    [
        ({"reliability": ReliabilityPolicy.BEST_EFFORT}, {}),
        ({}, {"durability": LATCHED}),
    ],
)
def test_ends_that_dds_would_not_connect_are_not(offered, requested):
    exchange = Exchange()
    outlet, subscriber = _outlet(exchange, **offered), Subscriber(exchange, **requested)
    _texts(outlet, "a")
    assert subscriber.deliver() == []
    # DDS counts no such subscriber either: only somebody outside makes the difference.
    assert outlet.wants_dds(1)
    assert not outlet.wants_dds(0)


def test_another_type_under_the_same_name_gets_nothing():
    exchange = Exchange()
    outlet, other = _outlet(exchange), Subscriber(exchange, Int32)
    _texts(outlet, "a")
    assert other.deliver() == []


def test_dds_is_for_listeners_outside_and_for_what_is_latched():
    exchange = Exchange()
    outlet = _outlet(exchange)
    Subscriber(exchange)
    Subscriber(exchange)
    assert not outlet.wants_dds(2)
    assert outlet.wants_dds(3)
    assert _outlet(exchange, durability=LATCHED).wants_dds(0)


def test_a_subscriber_that_left_gets_nothing_and_does_not_count():
    exchange = Exchange()
    outlet, gone = _outlet(exchange), Subscriber(exchange)
    _texts(outlet, "a")
    exchange.remove_inbox(gone.inbox)
    _texts(outlet, "b")
    assert gone.deliver() == []
    assert outlet.wants_dds(1)


def test_what_a_publisher_that_is_gone_sent_is_still_delivered():
    exchange = Exchange()
    outlet, subscriber = _outlet(exchange), Subscriber(exchange)
    _texts(outlet, "a")
    exchange.remove_outlet(outlet)
    assert [m.data for m in subscriber.deliver()] == ["a"]


@pytest.mark.parametrize("first", ["publisher", "subscriber"])
def test_nothing_is_kept_of_who_is_gone(first):
    exchange = Exchange()
    outlet, subscriber = _outlet(exchange, durability=LATCHED), Subscriber(exchange)
    (message,) = _texts(outlet, "a")
    inbox, outlet_gone = weakref.ref(subscriber.inbox), weakref.ref(outlet)
    for end in ("publisher", "subscriber") if first == "publisher" else ("subscriber", "publisher"):
        if end == "publisher":
            exchange.remove_outlet(outlet)
        else:
            exchange.remove_inbox(subscriber.inbox)
    # The ends themselves, and the message.
    assert sys.getrefcount(message) == 2
    del outlet, subscriber
    gc.collect()
    assert inbox() is None
    assert outlet_gone() is None


def test_what_comes_back_over_dds_is_known_by_its_publisher():
    exchange = Exchange()
    outlet, subscriber = _outlet(exchange, gid=bytes(range(16))), Subscriber(exchange)
    own = {"source_timestamp": 0, "publisher_gid": {"data": bytes(range(16))}}
    foreign = {"source_timestamp": 0, "publisher_gid": {"data": bytes(16)}}
    assert exchange.handed_over(subscriber.inbox, own)
    assert not exchange.handed_over(subscriber.inbox, foreign)
    exchange.remove_outlet(outlet)
    assert exchange.handed_over(subscriber.inbox, own)


def test_where_the_publisher_is_unknown_the_time_of_sending_decides():
    exchange = Exchange()
    outlet, subscriber = _outlet(exchange, gid=bytes(16)), Subscriber(exchange)
    stamps = []

    def publish(_message) -> None:
        import time

        stamps.append(time.time_ns())
        # What comes back may come while it is still being published.
        assert exchange.handed_over(subscriber.inbox, {"source_timestamp": stamps[-1]})

    outlet.send(publish, String())
    assert outlet.sent_over_dds == 1
    assert exchange.handed_over(subscriber.inbox, {"source_timestamp": stamps[0]})
    for offset in (-(10**9), 10**9):
        info = {"source_timestamp": stamps[0] + offset}
        assert not exchange.handed_over(subscriber.inbox, info)


def test_what_only_dds_does_is_left_to_it():
    assert fits_intra_process(QoSProfile(depth=1))
    assert not fits_intra_process(QoSProfile(depth=1, deadline=Duration(seconds=1)))
    assert not fits_intra_process(QoSProfile(depth=1, lifespan=Duration(seconds=1)))
