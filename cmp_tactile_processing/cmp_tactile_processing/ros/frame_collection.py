"""Services that use the next frames and answer once that is done."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

__all__ = ["FrameCollection", "FrameService"]

Frame = TypeVar("Frame")


class FrameCollection(Generic[Frame]):
    """Takes `wanted` frames; `outcome` becomes (success, explanation) once they are used."""

    def __init__(self, wanted: int) -> None:
        self.wanted = wanted
        self.frames: list[Frame] = []
        self.outcome: Future[tuple[bool, str]] = Future()

    def add(self, frame: Frame) -> bool:
        """Whether this frame was the last one needed."""
        self.frames.append(frame)
        return len(self.frames) == self.wanted

    def finish(self, success: bool, explanation: str) -> None:
        """Settle the outcome; a second time changes nothing."""
        if not self.outcome.done():
            self.outcome.set_result((success, explanation))

    async def awaited(self, node: Node, timeout_s: float, topics: str) -> tuple[bool, str]:
        """The outcome, at the latest after timeout_s; topics: where the frames come from."""

        def give_up() -> None:
            found = f"found {len(self.frames)} frames on {topics} in {timeout_s:g} s"
            self.finish(False, f"{found}, expected {self.wanted}")

        timer = node.create_timer(timeout_s, give_up, clock=Clock(clock_type=ClockType.STEADY_TIME))
        result = await self.outcome
        node.destroy_timer(timer)
        return (bool(result[0]), str(result[1]))


class FrameService(Generic[Frame]):
    """A Trigger service that collects frames, one request at a time.

    name: the service's; busy: the answer while another request is open; wanted: tells number of
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
        if self._open is None or not self._open.add(frame):
            return None
        collection, self._open = self._open, None
        return collection

    async def _answer(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        if self._open is not None:
            response.success, response.message = False, self._busy
            return response
        count, timeout_s, topics = self._wanted()
        collection = self._open = FrameCollection[Frame](count)
        response.success, response.message = await collection.awaited(self._node, timeout_s, topics)
        if self._open is collection:
            self._open = None
        return response
