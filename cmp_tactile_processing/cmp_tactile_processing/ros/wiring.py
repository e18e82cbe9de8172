"""Which node of a sensor feeds which: results pass from node to node by a plain call.

A node has outputs and inputs, each with a topic.  Where nodes of a sensor share a container, its
`Wiring` connects them: what a stage made goes to the next one as the object of the core, on the
same thread, so nobody may change it afterwards.  A message is made, once, where somebody else
subscribes.  Frames of a source come on its own thread and wait in a `FrameQueue`, the only queue.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cached_property, partial
from queue import SimpleQueue
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.qos import HistoryPolicy
from rclpy.time_source import TimeSource

from cmp_tactile_processing.cache.threads import ViewThreads, one_thread
from cmp_tactile_processing.ros.shared_clock import ClockListener, SharedClock

WAIT_S = 0.1
"""After how long without room a source looks whether it still waits."""
Info = Mapping[str, Any]
"""Of a message: stamps, number and publisher, as rclpy's MessageInfo has them."""

Finish = Callable[[], None]
"""The rest of the work on a frame, on the thread of the sensor."""


class LazyResult:
    """What a node gives of one frame: a value of the core, and a message that says the same.

    Each is made at its first use.  header: of the message, None for one without, which is only
    recorded.  info: None where it came by a plain call, not over DDS.
    """

    def __init__(
        self,
        header: Any,
        make_value: Callable[[], Any],
        make_message: Callable[[], Any],
        info: Info | None = None,
    ) -> None:
        self.header, self.info = header, info
        self._make_value, self._make_message = make_value, make_message

    @cached_property
    def value(self) -> Any:
        """Raises CmpTactileError where a message cannot be used."""
        return self._make_value()

    @cached_property
    def message(self) -> Any:
        """A message of ROS's own class."""
        return self._make_message()


class Input:
    """Where a topic comes in.

    dropped: frames in whose place newer ones came.  subscription: over DDS; it
    is not looked at while an output of the same container is connected.  is_wired: whether its node
    is there, and a wiring may connect it.
    """

    def __init__(
        self,
        begin: Callable[[LazyResult], Finish],
        from_msg: Callable[[Any], Any] = lambda message: message,
        needs_all: Callable[[], bool] = lambda: True,
    ) -> None:
        """begin: works on a frame, beside that of another view; needs_all: see `Output`."""
        self.begin, self.needs_all = begin, needs_all
        self._from_msg = from_msg
        self.gate = _Gate()
        self.subscription: Any = None
        self.is_wired = False
        self.dropped = self.queued = 0

    @property
    def depth(self) -> int | None:
        """Frames that may wait; None for all."""
        qos = self.subscription.qos_profile
        return None if qos.history is HistoryPolicy.KEEP_ALL else max(1, qos.depth)

    def take(self, given: LazyResult) -> None:
        """Work on a frame."""
        self.begin(given)()

    def take_message(self, message: Any, info: Info) -> None:
        """The callback of the subscription."""
        read, header = partial(self._from_msg, message), getattr(message, "header", None)
        self.take(LazyResult(header, read, lambda: message, info))

    def listen_to_dds(self, wanted: bool) -> None:
        """Look at the subscription from now on, at what is yet to come, or not."""
        if wanted and not self.gate.is_open:
            handle = self.subscription.handle
            with handle:
                while handle.take_message(self.subscription.msg_type, True) is not None:
                    pass
        self.gate.is_open = wanted


class _Gate(MutuallyExclusiveCallbackGroup):
    """Of a subscription that an executor waits for only while the gate is open."""

    def __init__(self) -> None:
        super().__init__()
        self.is_open = True

    def can_execute(self, entity: Any) -> bool:
        """As the base class has it, while it is open."""
        return self.is_open and bool(super().can_execute(entity))


def never() -> bool:
    """Nothing waits."""
    return False


class FrameQueue:
    """Frames of another thread that wait for the thread of the sensor.

    Where there is no room, the source waits while `waits` says so, as for a recording; else, and
    where only the newest frame is asked for, the oldest is dropped.
    """

    def __init__(
        self, end: Input, wake: Callable[[FrameQueue], None], waits: Callable[[], bool] = never
    ) -> None:
        self.end, self._wake, self._waits = end, wake, waits
        self._waiting: deque[LazyResult] = deque()
        self._changed = threading.Condition()

    def take(self, given: LazyResult) -> None:
        """Let a frame wait."""
        depth = self.end.depth
        with self._changed:
            # A depth of 1 asks for the newest.
            while depth not in (None, 1) and len(self._waiting) == depth and self._waits():
                self._changed.wait(WAIT_S)
            if depth is not None and len(self._waiting) == depth:
                self._waiting.popleft()
                self.end.dropped += 1
            self._waiting.append(given)
            self.end.queued = len(self._waiting)
        self._wake(self)

    def pass_on(self) -> None:
        """Let the input take the oldest."""
        with self._changed:
            given = self._waiting.popleft() if self._waiting else None
            self.end.queued = len(self._waiting)
            self._changed.notify()
        if given is not None and self.end.is_wired:
            self.end.take(given)


class Output:
    """Publishes what a node makes, as messages only while somebody outside subscribes.

    Of a value that takes long to make whole, `is_wanted` says whether anybody needs all of it.
    """

    def __init__(
        self,
        publisher: Any,
        to_msg: Callable[[Any, Any], Any],
        *,
        own_thread: bool = False,
        waits: Callable[[], bool] = never,
    ) -> None:
        """to_msg: makes a message of value and header.  own_thread: it publishes on a thread of
        its own, not on that of the sensor; waits: whether that thread may be held up now.
        """
        self.publisher, self.own_thread, self.waits = publisher, own_thread, waits
        self._to_msg = to_msg
        self.ends: tuple[Input | FrameQueue, ...] = ()

    @property
    def topic_name(self) -> str:
        """Resolved."""
        return str(self.publisher.topic_name)

    @property
    def is_heard(self) -> bool:
        """Whether somebody subscribes who is not connected."""
        return bool(self.publisher.get_subscription_count() > len(self.ends))

    @property
    def is_wanted(self) -> bool:
        """Whether anybody needs the whole value."""
        return self.is_heard or any(input_of(end).needs_all() for end in self.ends)

    def publish(self, value: Any, header: Any) -> None:
        """Give away a value, which nobody may change any more; first to the next stage."""
        given = self.given(value, header)
        for end in self.ends:
            end.take(given)
        self.send(given)

    def given(self, value: Any, header: Any) -> LazyResult:
        """What the ends of this output take."""
        return LazyResult(header, lambda: value, partial(self._to_msg, value, header))

    def send(self, given: LazyResult) -> None:
        """Publish the message, where somebody subscribes."""
        if self.is_heard and getattr(self.publisher, "is_activated", True):
            self.publisher.publish(given.message)


def input_of(end: Input | FrameQueue) -> Input:
    """Where an end of an output leads to."""
    return end.end if isinstance(end, FrameQueue) else end


def publish_side_by_side(
    outputs: Sequence[Output], values: Sequence[Any], headers: Sequence[Any], threads: ViewThreads
) -> None:
    """Publish a value of each output; what they begin runs at once, and is finished in order."""
    given = [
        output.given(value, header)
        for output, value, header in zip(outputs, values, headers, strict=True)
    ]
    begins = [
        (input_of(end), item)
        for output, item in zip(outputs, given, strict=True)
        for end in output.ends
    ]
    for finish in threads.map(lambda begin: begin[0].begin(begin[1]), begins):
        finish()
    for output, item in zip(outputs, given, strict=True):
        output.send(item)


class FairLock:
    """A lock for which a thread that waits comes before one that has just released it.

    Python's own may be taken again and again by one busy thread, while the other starves.
    """

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._held = threading.Lock()

    def __enter__(self) -> None:
        with self._turn:
            self._held.acquire()

    def __exit__(self, *_: object) -> None:
        self._held.release()


class Wiring:
    """Connects the outputs and inputs of one sensor's nodes in a container.

    lock: whoever calls a node holds it: the thread of the frames, and that of the executor.
    clock: from which its nodes have simulated time; None where each subscribes.
    """

    def __init__(self, clock: SharedClock | None = None) -> None:
        self.lock, self.clock = FairLock(), clock
        self._outputs: list[Output] = []
        self._inputs: list[Input] = []
        self._due: SimpleQueue[FrameQueue | None] = SimpleQueue()
        self._thread: threading.Thread | None = None

    def add(self, *ends: Output | Input) -> None:
        """Connect ends from now on.  Hold the lock."""
        for end in ends:
            if isinstance(end, Output):
                self._outputs.append(end)
            else:
                self._inputs.append(end)
                end.is_wired = True
        self._connect()

    def remove(self, *ends: Output | Input) -> None:
        """Connect ends no more.  Hold the lock."""
        for end in ends:
            if isinstance(end, Output):
                self._outputs.remove(end)
                end.ends = ()
            elif end.is_wired:
                self._inputs.remove(end)
                end.is_wired = False
        self._connect()

    def _connect(self) -> None:
        connected = set()
        for output in self._outputs:
            known = {input_of(end): end for end in output.ends}
            fitting = [item for item in self._inputs if _fit(output, item)]
            output.ends = tuple(known.get(item) or self._end(output, item) for item in fitting)
            connected.update(fitting)
        for item in self._inputs:
            item.listen_to_dds(item not in connected)

    def close(self) -> None:
        """Take no more frames; waits for the last one."""
        if self._thread is not None:
            self._due.put(None)
            self._thread.join()
            self._thread = None

    def _end(self, output: Output, end: Input) -> Input | FrameQueue:
        if not output.own_thread:
            return end
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="frames", daemon=True)
            self._thread.start()
        return FrameQueue(end, self._due.put, output.waits)

    def _work(self) -> None:
        while (queue := self._due.get()) is not None:
            with self.lock, one_thread():  # entered here it costs the stages nothing
                try:
                    queue.pass_on()
                except BaseException as error:  # noqa: BLE001  the next frame may be better
                    get_logger("wiring").error(f"a frame was lost: {error!r}")


def _fit(output: Output, end: Input) -> bool:
    one, other = output.publisher, end.subscription
    return bool(one.topic_name == other.topic_name and one.msg_type is other.msg_type)


_joined: ContextVar[Wiring | None] = ContextVar("wiring", default=None)


@contextmanager
def joining(wiring: Wiring | None) -> Iterator[None]:
    """Nodes that are built in here are connected by this wiring; None for by none."""
    token = _joined.set(wiring)
    try:
        yield
    finally:
        _joined.reset(token)


class WiredNode(Node):
    """Stands before Node or LifecycleNode among the bases of a node with outputs and inputs.

    In a container, outputs are connected as they are made, for a source may begin at once; inputs
    once `attach` says that the node is built.
    """

    _wiring: Wiring | None = None

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._wiring = _joined.get()
        self._attached = self._wiring is None
        self._ends: list[Output | Input] = []
        self._listeners: list[ClockListener] = []
        super().__init__(*args, **kwargs)

    def attach(self) -> None:
        """Connect the inputs, as the node is built.  The container holds the lock."""
        self._attached = True
        if self._wiring is not None:
            self._wiring.add(*(item for item in self._ends if isinstance(item, Input)))

    def detach(self) -> None:
        """Connect nothing any more, before the node is destroyed.  The container holds the lock."""
        if self._wiring is not None:
            self._wiring.remove(*self._ends)
            self._wiring = None

    def destroy_node(self) -> None:
        """As Node's; of a node whose constructor has failed, the outputs are connected no more."""
        wiring = self._wiring
        if wiring is not None:
            with wiring.lock:
                self.detach()
        for listener in self._listeners:
            listener.close()
        self._listeners.clear()
        super().destroy_node()

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, *args: Any, **kwargs: Any
    ) -> Any:
        """As Node's.  In a container, what rclpy itself hears of simulated time is shared."""
        clock = None if self._wiring is None else self._wiring.clock
        if clock is None or not isinstance(getattr(callback, "__self__", None), TimeSource):
            return super().create_subscription(msg_type, topic, callback, *args, **kwargs)
        listener = clock.listen(self.resolve_topic_name(topic), callback)
        self._listeners.append(listener)
        return listener

    def destroy_subscription(self, subscription: Any) -> bool:
        """As Node's."""
        if not isinstance(subscription, ClockListener):
            return bool(super().destroy_subscription(subscription))
        subscription.close()
        self._listeners.remove(subscription)
        return True

    def add_output(
        self,
        publisher: Any,
        to_msg: Callable[[Any, Any], Any],
        *,
        own_thread: bool = False,
        waits: Callable[[], bool] = never,
    ) -> Output:
        """What the publisher sends, for the next stage too: see `Output`."""
        output = Output(publisher, to_msg, own_thread=own_thread, waits=waits)
        self._ends.append(output)
        if self._wiring is not None:
            with self._wiring.lock:
                self._wiring.add(output)
        return output

    def connect_input(
        self, end: Input, message_type: Any, topic: str, qos: Any, **kwargs: Any
    ) -> None:
        """Subscribe; kwargs: those of create_subscription."""
        end.subscription = self.create_subscription(
            message_type, topic, end.take_message, qos, callback_group=end.gate, **kwargs
        )
        self._ends.append(end)
        if self._attached and self._wiring is not None:
            self._wiring.add(end)

    def disconnect_input(self, end: Input) -> None:
        """Unsubscribe."""
        self._ends.remove(end)
        if self._wiring is not None:
            self._wiring.remove(end)
        self.destroy_subscription(end.subscription)
