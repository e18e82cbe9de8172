"""Intra-process communication: messages between components go as the objects that they are.

An `Exchange` joins what its members publish and subscribe to.  Between them a message is neither
serialised nor copied, so whoever gets one must not change it, nor may its publisher afterwards.
What a stage made goes as a `Result`, whose message is made when the first subscriber needs one.
Order, depth of the queue, QoS that does not fit, and what late subscribers of a latched topic get
are as over DDS.  An `IntraProcessNode` is a member by its publishers and subscriptions.
"""

from __future__ import annotations

import inspect
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, TypeAlias

from rclpy.duration import Duration, Infinite
from rclpy.lifecycle.publisher import LifecyclePublisher
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSCompatibility,
    QoSProfile,
    qos_check_compatible,
)
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

if TYPE_CHECKING:
    AnyPublisher: TypeAlias = Publisher[Any]
    AnyLifecyclePublisher: TypeAlias = LifecyclePublisher[Any]
else:
    # In ROS 2 Jazzy they are not generic.
    AnyPublisher, AnyLifecyclePublisher = Publisher, LifecyclePublisher


Info = Mapping[str, Any]
"""Of a message: stamps, number and publisher, as rclpy's MessageInfo has them."""

# Messages that went over DDS too and may still come back: more than any queue of ours holds.
REMEMBERED_SENDINGS = 256
# Publishers that are gone, but whose messages may still come over DDS; of each topic.
REMEMBERED_OUTLETS = 4


@dataclass(frozen=True)
class Terms:
    """What two ends must agree on.  topic: fully resolved."""

    topic: str
    message_type: type
    qos: QoSProfile

    @property
    def depth(self) -> int | None:
        """Messages that are kept; None for all."""
        if self.qos.history is HistoryPolicy.KEEP_ALL:
            return None
        return max(1, self.qos.depth)

    @property
    def latched(self) -> bool:
        """Whether late subscribers get the last messages."""
        return bool(self.qos.durability is DurabilityPolicy.TRANSIENT_LOCAL)


def fits_intra_process(qos: QoSProfile) -> bool:
    """Whether this profile asks for nothing that only DDS does: deadlines, lifespans, leases."""
    unlimited = (Duration(), Infinite)
    return all(
        span in unlimited for span in (qos.deadline, qos.lifespan, qos.liveliness_lease_duration)
    )


class Result:
    """What a stage made, and the message that says it: type adaptation, as in REP 2007.

    value: as the next stage takes it; nobody may change it.  header: of the message.
    """

    def __init__(self, value: Any, header: Any, to_msg: Callable[[Any, Any], Any]) -> None:
        """to_msg: makes the message of value and header."""
        self.value = value
        self.header = header
        self._to_msg = to_msg
        self._lock = threading.Lock()
        self._message: Any = None

    def message(self) -> Any:
        """The message, made once, on the thread that first asks."""
        with self._lock:
            if self._message is None:
                self._message = self._to_msg(self.value, self.header)
            return self._message


class Inbox:
    """The receiving end: messages that wait for the callback of one subscription.

    dropped: how many were dropped so far because the queue was full.
    """

    def __init__(
        self,
        terms: Terms,
        callback: Callable[..., object],
        post: Callable[[Inbox], None],
        *,
        with_info: bool = False,
        takes_results: bool = False,
    ) -> None:
        """post: notifies the subscriber of a message.  with_info: the callback takes it too.

        takes_results: the callback takes a Result as it takes a message.
        """
        self.terms = terms
        self._callback = callback
        self._post = post
        self._with_info = with_info
        self._takes_results = takes_results
        self._waiting: deque[tuple[Any, Info]] = deque()
        self._lock = threading.Lock()
        self.dropped = 0
        self._open = True

    @property
    def queued(self) -> int:
        """How many messages wait."""
        return len(self._waiting)

    def put(self, message: Any, info: Info) -> None:
        """Take a message in; the oldest is dropped where more wait than the QoS keeps."""
        depth = self.terms.depth
        with self._lock:
            if not self._open:
                return
            self._waiting.append((message, info))
            if depth is not None and len(self._waiting) > depth:
                self._waiting.popleft()
                self.dropped += 1
                return
        self._post(self)

    def deliver(self) -> None:
        """Run the callback with the oldest message, on the thread of the subscriber."""
        with self._lock:
            if not self._waiting:
                return
            message, info = self._waiting.popleft()
        if isinstance(message, Result) and not self._takes_results:
            message = message.message()
        if self._with_info:
            self._callback(message, info)
        else:
            self._callback(message)

    def close(self) -> None:
        """Take nothing in any more."""
        with self._lock:
            self._open = False
            self._waiting.clear()


class Outlet:
    """The sending end of one publisher.

    sent_over_dds: how many messages went over DDS so far.
    """

    def __init__(self, terms: Terms, gid: bytes) -> None:
        """gid: by which messages of this publisher are known that come over DDS; may be empty."""
        self.terms = terms
        self.gid = gid
        self.inboxes: tuple[Inbox, ...] = ()
        self._kept: deque[tuple[Any, Info]] = deque(maxlen=terms.depth)
        self._lock = threading.Lock()
        self._count = 0
        self.sent_over_dds = 0
        self._sendings: deque[tuple[int, int]] = deque(maxlen=REMEMBERED_SENDINGS)

    def intra_process(self, message: Any) -> None:
        """Put a message into all inboxes, in the order of these calls."""
        with self._lock:
            self._count += 1
            now = time.time_ns()
            info = {
                "source_timestamp": now,
                "received_timestamp": now,
                "publication_sequence_number": self._count,
                "reception_sequence_number": None,
                "publisher_gid": None,
            }
            if self.terms.latched:
                self._kept.append((message, info))
            for inbox in self.inboxes:
                inbox.put(message, info)

    def wants_dds(self, subscription_count: int) -> bool:
        """Whether somebody outside may listen: now, or later to what is latched."""
        return self.terms.latched or subscription_count > len(self.inboxes)

    def send(self, publish: Callable[[Any], None], message: Any) -> None:
        """Publish over DDS, and remember when, so that what comes back is known."""
        before = time.time_ns()
        with self._lock:
            # Its end is not known yet, and it may come back before it is.
            self._sendings.append((before, before + 10**9))
            self.sent_over_dds += 1
        publish(message)
        with self._lock:
            self._sendings.remove((before, before + 10**9))
            self._sendings.append((before, time.time_ns()))

    def sent(self, info: Info) -> bool:
        """Whether a message that came over DDS is one of this publisher."""
        gid = info.get("publisher_gid")
        if gid is not None and self.gid:
            return bytes(gid["data"])[: len(self.gid)] == self.gid
        # ROS 2 Jazzy does not name the publisher: by the time of sending.
        stamp = info["source_timestamp"]
        with self._lock:
            return any(begin <= stamp <= end for begin, end in self._sendings)

    def join(self, inbox: Inbox) -> None:
        """Put into this inbox from now on, first of all what is latched."""
        with self._lock:
            if self.terms.latched and inbox.terms.latched:
                for message, info in self._kept:
                    inbox.put(message, info)
            self.inboxes = (*self.inboxes, inbox)

    def leave(self, inbox: Inbox) -> None:
        """Put into this inbox no more."""
        with self._lock:
            self.inboxes = tuple(item for item in self.inboxes if item is not inbox)

    def retire(self) -> None:
        """Keep no messages: nothing is published any more."""
        with self._lock:
            self._kept.clear()


class Exchange:
    """Joins the outlets and inboxes of its members.  All methods may be called on any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._outlets: dict[str, tuple[Outlet, ...]] = {}
        self._inboxes: dict[str, tuple[Inbox, ...]] = {}
        self._gone: dict[str, tuple[Outlet, ...]] = {}

    def add_outlet(self, outlet: Outlet) -> None:
        """Let a publisher's messages pass from now on."""
        topic = outlet.terms.topic
        with self._lock:
            self._outlets[topic] = (*self._outlets.get(topic, ()), outlet)
            for inbox in self._inboxes.get(topic, ()):
                if _agree(outlet.terms, inbox.terms):
                    outlet.join(inbox)

    def add_inbox(self, inbox: Inbox) -> None:
        """Let a subscription get messages from now on."""
        topic = inbox.terms.topic
        with self._lock:
            self._inboxes[topic] = (*self._inboxes.get(topic, ()), inbox)
            for outlet in self._outlets.get(topic, ()):
                if _agree(outlet.terms, inbox.terms):
                    outlet.join(inbox)

    def remove_outlet(self, outlet: Outlet) -> None:
        """Forget a publisher; what waits in inboxes is still delivered."""
        topic = outlet.terms.topic
        with self._lock:
            # First among those that are gone: `handed_over` looks at any moment.
            gone = (*self._gone.get(topic, ()), outlet)[-REMEMBERED_OUTLETS:]
            _keep(self._gone, topic, tuple(item for item in gone if item.inboxes))
            left = tuple(item for item in self._outlets.get(topic, ()) if item is not outlet)
            _keep(self._outlets, topic, left)
            outlet.retire()

    def remove_inbox(self, inbox: Inbox) -> None:
        """Forget a subscription and what waits for it."""
        topic = inbox.terms.topic
        with self._lock:
            left = tuple(item for item in self._inboxes.get(topic, ()) if item is not inbox)
            _keep(self._inboxes, topic, left)
            gone = self._gone.get(topic, ())
            for outlet in (*self._outlets.get(topic, ()), *gone):
                outlet.leave(inbox)
            # Else what is unloaded would be kept by what was unloaded before.
            _keep(self._gone, topic, tuple(item for item in gone if item.inboxes))
        inbox.close()

    def handed_over(self, inbox: Inbox, info: Info) -> bool:
        """Whether a message that came over DDS was handed over to this inbox already."""
        topic = inbox.terms.topic
        outlets = (*self._outlets.get(topic, ()), *self._gone.get(topic, ()))
        return any(inbox in outlet.inboxes and outlet.sent(info) for outlet in outlets)


class Member:
    """One component's part in an exchange: what waits for it, on a thread of its own."""

    def __init__(self, exchange: Exchange) -> None:
        self.exchange = exchange
        self._work: SimpleQueue[Inbox | None] = SimpleQueue()

    def post(self, inbox: Inbox) -> None:
        """Have the oldest message of an inbox delivered."""
        self._work.put(inbox)

    def next(self) -> Inbox | None:
        """Wait for the next inbox with a message; None after `stop`."""
        return self._work.get()

    def stop(self) -> None:
        """Let `next` return None, after all that was posted before."""
        self._work.put(None)


def _keep(ends: dict[str, tuple[Any, ...]], topic: str, left: tuple[Any, ...]) -> None:
    if left:
        ends[topic] = left
    else:
        ends.pop(topic, None)


def _agree(offered: Terms, requested: Terms) -> bool:
    if offered.message_type is not requested.message_type:
        return False
    verdict, _ = qos_check_compatible(offered.qos, requested.qos)
    return bool(verdict != QoSCompatibility.ERROR)


_joined: ContextVar[Member | None] = ContextVar("intra_process_member", default=None)


@contextmanager
def joining(member: Member | None) -> Iterator[None]:
    """Nodes that are built in here are this member of an exchange; None for of none."""
    token = _joined.set(member)
    try:
        yield
    finally:
        _joined.reset(token)


def inbox_of(subscription: Subscription[Any]) -> Inbox | None:
    """Where messages for a subscription wait that are handed over; None where none are."""
    found = getattr(subscription, "inbox", None)
    return found if isinstance(found, Inbox) else None


class IntraProcessPublisher(AnyPublisher):
    """Hands over what it publishes; over DDS it goes only while somebody outside listens."""

    outlet: Outlet | None = None

    def publish(self, msg: Any) -> None:
        """Publish a message, which must not be changed afterwards."""
        _publish(self, super().publish, msg)


class _LifecycleIntraProcessPublisher(AnyLifecyclePublisher):
    """The same for a publisher that is silent until its node is activated."""

    outlet: Outlet | None = None

    def publish(self, msg: Any) -> None:
        if self.is_activated:
            _publish(self, super().publish, msg)


def _publish(publisher: Any, publish: Callable[[Any], None], msg: Any) -> None:
    outlet = publisher.outlet
    if outlet is None or not isinstance(msg, (publisher.msg_type, bytes, Result)):
        publish(msg)
        return
    if outlet.inboxes or outlet.terms.latched:
        whole = deserialize_message(msg, publisher.msg_type) if isinstance(msg, bytes) else msg
        outlet.intra_process(whole)
    if outlet.wants_dds(publisher.get_subscription_count()):
        outlet.send(publish, msg.message() if isinstance(msg, Result) else msg)


def publish_result(publisher: Any, result: Result) -> None:
    """Publish what a stage made; no message is made where nobody listens."""
    if getattr(publisher, "outlet", None) is not None:
        publisher.publish(result)
    elif publisher.get_subscription_count():
        publisher.publish(result.message())


class IntraProcessNode(Node):
    """Stands before Node or LifecycleNode among the bases of a component.

    In a component container its messages are handed over to the other such nodes of the container;
    elsewhere it is a node as any other.
    """

    _member: Member | None = None

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # What the base class has created by now, such as /parameter_events, goes over DDS alone.
        self._member = _joined.get()

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **kwargs: Any) -> Any:
        """As Node's."""
        if self._member is None or kwargs.get("publisher_class") not in (
            None,
            _LifecycleIntraProcessPublisher,
        ):
            return super().create_publisher(msg_type, topic, qos_profile, **kwargs)
        kwargs.setdefault("publisher_class", IntraProcessPublisher)
        known = self._gids(topic)
        publisher = super().create_publisher(msg_type, topic, qos_profile, **kwargs)
        if fits_intra_process(publisher.qos_profile):
            gid = next(iter(self._gids(topic) - known), b"")
            terms = Terms(publisher.topic_name, msg_type, publisher.qos_profile)
            publisher.outlet = Outlet(terms, gid)
            self._member.exchange.add_outlet(publisher.outlet)
        return publisher

    def create_lifecycle_publisher(self, *args: Any, **kwargs: Any) -> Any:
        """As LifecycleNode's."""
        publisher = self.create_publisher(
            *args, publisher_class=_LifecycleIntraProcessPublisher, **kwargs
        )
        # What LifecycleNode's own method does beside creating a publisher of rclpy's class.
        self._managed_entities.add(publisher)
        return publisher

    def destroy_lifecycle_publisher(self, publisher: Any) -> bool:
        """As LifecycleNode's, which in ROS 2 Jazzy passes over `destroy_publisher`."""
        self._managed_entities.discard(publisher)
        return self.destroy_publisher(publisher)

    def create_subscription(
        self,
        msg_type: Any,
        topic: str,
        callback: Callable[..., Any],
        qos_profile: Any,
        *,
        takes_results: bool = False,
        **kwargs: Any,
    ) -> Any:
        """As Node's.  takes_results: the callback takes a Result as it takes a message."""
        member = self._member
        left_to_dds = kwargs.get("raw") or kwargs.get("content_filter_options")
        # A coroutine goes on when the executor has time, which knows nothing of an inbox.
        if member is None or left_to_dds or inspect.iscoroutinefunction(callback):
            return super().create_subscription(msg_type, topic, callback, qos_profile, **kwargs)
        receiver = _Receiver(callback)
        subscription = super().create_subscription(
            msg_type, topic, receiver.from_dds, qos_profile, **kwargs
        )
        if fits_intra_process(subscription.qos_profile):
            terms = Terms(subscription.topic_name, msg_type, subscription.qos_profile)
            inbox = Inbox(
                terms,
                callback,
                member.post,
                with_info=receiver.with_info,
                takes_results=takes_results,
            )
            receiver.known = lambda info: member.exchange.handed_over(inbox, info)
            subscription.inbox = inbox
            member.exchange.add_inbox(inbox)
        return subscription

    def destroy_publisher(self, publisher: Publisher[Any]) -> bool:
        """As Node's."""
        outlet = getattr(publisher, "outlet", None)
        if self._member is not None and outlet is not None:
            self._member.exchange.remove_outlet(outlet)
        return super().destroy_publisher(publisher)

    def destroy_subscription(self, subscription: Subscription[Any]) -> bool:
        """As Node's."""
        inbox = inbox_of(subscription)
        if self._member is not None and inbox is not None:
            self._member.exchange.remove_inbox(inbox)
        return super().destroy_subscription(subscription)

    def _gids(self, topic: str) -> set[bytes]:
        """Of this node's publishers: others may begin to publish at any moment."""
        infos = self.get_publishers_info_by_topic(self.resolve_topic_name(topic))
        own = self.get_name(), self.get_namespace()
        return {
            bytes(info.endpoint_gid)
            for info in infos
            if (info.node_name, info.node_namespace) == own
        }


class _Receiver:
    """Passes on what comes over DDS, without what was handed over."""

    def __init__(self, callback: Callable[..., Any]) -> None:
        self._callback = callback
        self.with_info = _takes_info(callback)
        self.known: Callable[[Info], bool] = lambda _: False

    def from_dds(self, message: Any, info: Info) -> Any:
        if self.known(info):
            return None
        return self._callback(message, info) if self.with_info else self._callback(message)


def _takes_info(callback: Callable[..., Any]) -> bool:
    """Whether a callback needs the info beside the message, as rclpy decides it."""
    signature = inspect.signature(callback)
    try:
        signature.bind(object())
    except TypeError:
        return True
    return False
