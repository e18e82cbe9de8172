"""Nodes of one sensor in one container: results pass by a plain call, and to others over DDS."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from rclpy.lifecycle import LifecycleNode
from rclpy.lifecycle.publisher import LifecyclePublisher
from rclpy.qos import QoSProfile
from ros_graph import RosGraph
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from waiting import wait_until

from cmp_tactile_processing.cache.threads import ViewThreads
from cmp_tactile_processing.ros.wiring import (
    Input,
    LazyResult,
    Output,
    WiredNode,
    Wiring,
    joining,
    publish_side_by_side,
)


def _to_msg(value: int, header: Header) -> Image:
    return Image(header=header, width=value)


def _of(given: LazyResult) -> int:
    value = given.value
    return int(value.width) if isinstance(value, Image) else int(value)


class Container(RosGraph):
    """Nodes that one wiring connects, and somebody outside."""

    def __init__(self) -> None:
        super().__init__()
        self.wiring = Wiring()
        self.sources: list[Any] = []

    def wired(self, name: str, *bases: type) -> Any:
        """A node of the container."""
        kind = type("Sample", bases or (WiredNode,), {})
        with joining(self.wiring):
            return self._add(kind(name, context=self.context, namespace=self.namespace))

    def stage(self, name: str, topic: str, **fields: Any) -> Stage:
        """A node with one input."""
        node = self.wired(name)
        stage = Stage(node, topic, **fields)
        with self.wiring.lock:
            node.attach()
        return stage

    def output(self, topic: str, **fields: Any) -> Output:
        """That of a node of its own."""
        node = self.wired(f"source_{len(self.sources)}")
        self.sources.append(node)
        return node.add_output(node.create_publisher(Image, topic, 10), _to_msg, **fields)

    def hear(self, topic: str) -> list[int]:
        """What arrives outside."""
        heard: list[int] = []
        self.node.create_subscription(Image, topic, lambda m: heard.append(m.width), 100)
        return heard

    def detach(self, node: Any) -> None:
        with self.wiring.lock:
            node.detach()

    def close(self) -> None:
        self.wiring.close()
        super().close()


class Stage:
    """Keeps what comes, and on which threads; `gate` holds the work up while it is closed."""

    def __init__(self, node: Any, topic: str, depth: int = 10, **qos: Any) -> None:
        self.node = node
        self.seen: list[int] = []
        self.values: list[Any] = []
        self.threads: list[int] = []
        self.gate = threading.Event()
        self.gate.set()
        self.end = Input(self._begin)
        node.connect_input(self.end, Image, topic, QoSProfile(depth=depth, **qos))

    def _begin(self, given: LazyResult) -> Any:
        self.threads.append(threading.get_ident())
        self.gate.wait()
        return lambda: (self.values.append(given.value), self.seen.append(_of(given)))


@pytest.fixture
def container() -> Iterator[Container]:
    container = Container()
    yield container
    container.close()


def test_a_value_passes_by_a_plain_call_and_dds_carries_nothing(container, monkeypatch):
    stage, output = container.stage("stage", "grid"), container.output("grid")
    sent: list[Any] = []
    monkeypatch.setattr(output.publisher, "publish", sent.append)
    container.wait(output.publisher.get_subscription_count, "the stage to be matched")
    value = 1234567
    output.publish(value, Header())
    assert stage.values[0] is value
    assert stage.threads == [threading.get_ident()]
    assert sent == []


def test_a_message_is_made_once_for_all_who_ask(container):
    made: list[int] = []

    def to_msg(value: int, header: Header) -> Image:
        made.append(value)
        return _to_msg(value, header)

    node = container.wired("source")
    output = node.add_output(node.create_publisher(Image, "grid", 10), to_msg)
    messages: list[Image] = []
    recorder = container.wired("recorder")
    end = Input(lambda given: lambda: messages.append(given.message))
    recorder.connect_input(end, Image, "grid", 10)
    with container.wiring.lock:
        recorder.attach()
    heard = container.hear("grid")
    container.wait(lambda: output.is_heard, "the listener")
    output.publish(2, Header())
    container.wait(lambda: 2 in heard, "the message outside")
    assert made == [2]
    assert [message.width for message in messages] == [2]


def test_a_stage_hears_dds_before_and_after_its_neighbour_is_there(container):
    stage = container.stage("stage", "grid")
    outside = container.node.create_publisher(Image, "grid", 10)
    container.wait(outside.get_subscription_count, "the stage")
    outside.publish(_to_msg(1, Header()))
    container.wait(lambda: stage.seen == [1], "a message from outside")
    output = container.output("grid")
    # What comes from elsewhere meanwhile is of another source, and is not looked at.
    outside.publish(_to_msg(2, Header()))
    output.publish(3, Header())
    container.run(0.2)
    assert stage.seen == [1, 3]
    container.detach(container.sources[-1])
    outside.publish(_to_msg(4, Header()))
    container.wait(lambda: 4 in stage.seen, "a message from outside, again")
    assert stage.seen == [1, 3, 4]


def test_a_source_is_not_held_up_and_the_newest_frame_is_taken(container):
    newest = container.stage("newest", "image", depth=1)
    every = container.stage("every", "image", depth=10)
    output = container.output("image", own_thread=True)
    newest.gate.clear()
    output.publish(0, Header())
    wait_until(lambda: newest.threads, "the first frame to be at work")
    for number in range(1, 6):
        output.publish(number, Header())
    newest.gate.set()
    wait_until(lambda: len(every.seen) == 6 and newest.seen[-1:] == [5], "the last frame")
    assert newest.seen == [0, 5]
    assert (newest.end.dropped, every.end.dropped) == (4, 0)
    assert every.seen == list(range(6))
    assert {*newest.threads, *every.threads} == {newest.threads[0]}
    assert newest.threads[0] != threading.get_ident()


def test_a_queue_that_is_full_drops_the_oldest_and_counts_it(container):
    stage = container.stage("stage", "image", depth=3)
    output = container.output("image", own_thread=True)
    with container.wiring.lock:
        for number in range(10):
            output.publish(number, Header())
        waiting = stage.end.queued
    wait_until(lambda: stage.end.dropped + len(stage.seen) == 10, "the rest")
    assert stage.seen[-3:] == [7, 8, 9]
    assert waiting == 3


def test_a_recording_waits_for_room_and_loses_nothing(container):
    """Reports: ros2/rosbag2 1254, ros/ros_comm 98; tried: 9 of 60 frames were passed over."""
    stage = container.stage("stage", "image", depth=2)
    playing = threading.Event()
    playing.set()
    output = container.output("image", own_thread=True, waits=playing.is_set)
    stage.gate.clear()

    def play() -> None:
        for number in range(12):
            output.publish(number, Header())

    player = threading.Thread(target=play)
    player.start()
    wait_until(lambda: stage.end.queued == 2, "the queue to be full")
    stage.gate.set()
    wait_until(lambda: len(stage.seen) == 12, "all frames")
    assert stage.seen == list(range(12))
    assert stage.end.dropped == 0
    stage.gate.clear()
    another = threading.Thread(target=play)
    another.start()
    wait_until(lambda: stage.end.queued == 2, "the queue to be full again")
    # It is stopped: nobody may wait for it without end.
    playing.clear()
    another.join(20.0)
    assert not another.is_alive()
    stage.gate.set()


def test_who_asks_for_the_newest_holds_no_recording_up(container):
    stage = container.stage("stage", "image", depth=1)
    output = container.output("image", own_thread=True, waits=lambda: True)
    stage.gate.clear()
    for number in range(5):
        output.publish(number, Header())
    stage.gate.set()
    wait_until(lambda: stage.seen and stage.seen[-1] == 4, "the newest frame")
    assert stage.end.dropped == 5 - len(stage.seen)


def test_both_views_are_begun_at_once_and_finished_in_order_on_one_thread(container):
    """Were one begun after the other, the first would wait for the second without end."""
    both = threading.Barrier(2)
    order: list[tuple[str, int]] = []
    outputs = []
    for view in ("left", "right"):
        node = container.wired(view)

        def begin(_given: LazyResult, view: str = view) -> Any:
            both.wait(timeout=60)
            return lambda: order.append((view, threading.get_ident()))

        node.connect_input(Input(begin), Image, f"{view}/image", 10)
        with container.wiring.lock:
            node.attach()
        outputs.append(container.output(f"{view}/image"))
    publish_side_by_side(outputs, [1, 2], [Header(), Header()], ViewThreads(2))
    here = threading.get_ident()
    assert order == [("left", here), ("right", here)]


def test_whole_values_are_wanted_while_anybody_looks(container):
    output = container.output("surface")
    assert not output.is_wanted
    looks = False
    node = container.wired("viewer")
    end = Input(lambda _: lambda: None, needs_all=lambda: looks)
    node.connect_input(end, Image, "surface", 10)
    with container.wiring.lock:
        node.attach()
    container.wait(output.publisher.get_subscription_count, "the viewer to be matched")
    assert not output.is_wanted
    looks = True
    assert output.is_wanted
    looks = False
    container.hear("surface")
    container.wait(lambda: output.is_wanted, "the listener outside")


def test_a_lifecycle_publisher_sends_no_message_before_it_is_active(container):
    stage = container.stage("stage", "image")
    node = container.wired("camera", WiredNode, LifecycleNode)
    publisher = node.create_lifecycle_publisher(Image, "image", 10)
    assert isinstance(publisher, LifecyclePublisher)
    output = node.add_output(publisher, _to_msg)
    heard = container.hear("image")
    container.wait(lambda: output.is_heard, "the listener")
    output.publish(1, Header())
    node.trigger_configure()
    node.trigger_activate()
    output.publish(2, Header())
    container.wait(lambda: heard, "a message")
    assert heard == [2]
    assert stage.seen == [1, 2]


def test_a_frame_that_cannot_be_used_loses_no_other(container):
    node = container.wired("stage")
    seen: list[int] = []

    def begin(given: LazyResult) -> Any:
        return lambda: seen.append(10 // _of(given))

    node.connect_input(Input(begin), Image, "image", 10)
    with container.wiring.lock:
        node.attach()
    output = container.output("image", own_thread=True)
    for number in (5, 0, 2):
        output.publish(number, Header())
    wait_until(lambda: seen == [2, 5], "the frames that can be used")


def test_frames_that_wait_for_a_stage_that_goes_are_dropped(container):
    stage = container.stage("stage", "image")
    other = container.stage("other", "image")
    output = container.output("image", own_thread=True)
    with container.wiring.lock:
        for number in range(3):
            output.publish(number, Header())
        stage.node.detach()
    wait_until(lambda: other.seen == [0, 1, 2], "the frames of who stays")
    assert stage.seen == []


def test_a_node_whose_constructor_fails_leaves_nothing_connected(container):
    class Fails(WiredNode):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            self.add_output(self.create_publisher(Image, "grid", 10), _to_msg)
            self.destroy_node()
            msg = "not here"
            raise ValueError(msg)

    stage = container.stage("stage", "grid")
    with joining(container.wiring), pytest.raises(ValueError, match="not here"):
        Fails("fails", context=container.context, namespace=container.namespace)
    assert stage.end.gate.is_open
    container.output("grid").publish(1, Header())
    assert stage.seen == [1]
