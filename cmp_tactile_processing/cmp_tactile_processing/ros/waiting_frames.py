"""Frames that wait: for as many as a request wants, or for their partner of the same stamp."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

Frame = TypeVar("Frame")


class FrameCollection(Generic[Frame]):
    """Frames that a request waits for; `finish` answers it, once they are used."""

    def __init__(self, wanted: int) -> None:
        self.wanted = wanted
        self.frames: list[Frame] = []
        self.outcome: Future[tuple[bool, str]] = Future()

    def finish(self, success: bool, explanation: str) -> None:
        """Settle the outcome; a second time changes nothing."""
        if not self.outcome.done():
            self.outcome.set_result((success, explanation))


class FrameService(Generic[Frame]):
    """A Trigger service that collects frames, one request at a time.

    name: the service's; busy: the answer while another request is open; wanted: gives number of
    frames, longest wait in s, and the topics that they come from.
    """

    def __init__(
        self, node: Node, name: str, busy: str, wanted: Callable[[], tuple[int, float, str]]
    ) -> None:
        self._node, self._busy, self._wanted = node, busy, wanted
        self._open: FrameCollection[Frame] | None = None
        # A group of its own: the service waits for frames, which must come in meanwhile.
        node.create_service(Trigger, name, self._answer, callback_group=ReentrantCallbackGroup())

    @property
    def is_open(self) -> bool:
        """Whether frames are being collected."""
        return self._open is not None

    def take(self, frame: Frame) -> FrameCollection[Frame] | None:
        """Add a frame; the collection to be used and finished where it was the last one needed."""
        collection = self._open
        if collection is None:
            return None
        collection.frames.append(frame)
        if len(collection.frames) < collection.wanted:
            return None
        self._open = None
        return collection

    async def _answer(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        if self._open is not None:
            response.success, response.message = False, self._busy
            return response
        count, timeout_s, topics = self._wanted()
        collection = self._open = FrameCollection[Frame](count)

        def give_up() -> None:
            found = f"found {len(collection.frames)} frames on {topics} in {timeout_s:g} s"
            collection.finish(False, f"{found}, expected {count}")

        executor = self._node.executor
        if executor is not None:
            # The last frame comes on another thread, which the executor does not see.
            collection.outcome.add_done_callback(lambda _: executor.wake())
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        timer = self._node.create_timer(timeout_s, give_up, clock=steady)
        response.success, response.message = await collection.outcome
        self._node.destroy_timer(timer)
        if self._open is collection:
            self._open = None
        return response


class StampPairing:
    """Holds what still waits for its partner, at most `capacity` items a side.

    Partners may come late, in any order, or never: an item is given up (and counted in
    `unpaired`) only when the buffer of its side is full or the same stamp comes again.
    """

    def __init__(self, sides: tuple[str, str], capacity: int = 20) -> None:
        self._capacity = capacity
        self._waiting: dict[str, dict[int, Any]] = {side: {} for side in sides}
        self._partner = dict(zip(sides, reversed(sides), strict=True))
        self._sides = sides
        self.unpaired = dict.fromkeys(sides, 0)

    def add(self, side: str, stamp_ns: int, item: Any) -> tuple[Any, Any] | None:
        """The pair that the item completes, in the order of `sides`, or None while it waits."""
        partner = self._waiting[self._partner[side]].pop(stamp_ns, None)
        if partner is not None:
            return (item, partner) if side == self._sides[0] else (partner, item)
        waiting = self._waiting[side]
        if waiting.pop(stamp_ns, None) is not None:
            self.unpaired[side] += 1
        elif len(waiting) == self._capacity:
            waiting.pop(next(iter(waiting)))
            self.unpaired[side] += 1
        waiting[stamp_ns] = item
        return None

    def forget(self, side: str) -> None:
        """Give up what waits on a side."""
        self.unpaired[side] += len(self._waiting[side])
        self._waiting[side].clear()
