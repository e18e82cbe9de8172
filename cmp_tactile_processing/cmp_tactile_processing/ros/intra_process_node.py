"""A node whose messages pass to the other components of its process without serialisation."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, TypeAlias

from rclpy.lifecycle.publisher import LifecyclePublisher
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from cmp_tactile_processing.ros.intra_process import (
    Inbox,
    Info,
    Member,
    Outlet,
    Terms,
    fits_intra_process,
)

if TYPE_CHECKING:
    AnyPublisher: TypeAlias = Publisher[Any]
    AnyLifecyclePublisher: TypeAlias = LifecyclePublisher[Any]
else:
    # In ROS 2 Jazzy they are not generic.
    AnyPublisher, AnyLifecyclePublisher = Publisher, LifecyclePublisher

__all__ = ["IntraProcessNode", "IntraProcessPublisher", "inbox_of", "joining"]

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
    if outlet is None or not isinstance(msg, (publisher.msg_type, bytes)):
        publish(msg)
        return
    if outlet.inboxes or outlet.terms.latched:
        whole = deserialize_message(msg, publisher.msg_type) if isinstance(msg, bytes) else msg
        outlet.intra_process(whole)
    if outlet.wants_dds(publisher.get_subscription_count()):
        outlet.send(publish, msg)


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
        **kwargs: Any,
    ) -> Any:
        """As Node's."""
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
            inbox = Inbox(terms, callback, member.post, with_info=receiver.with_info)
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
