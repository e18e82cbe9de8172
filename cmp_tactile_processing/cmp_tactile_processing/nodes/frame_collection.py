"""Collects the frames that a service was asked to use."""

from __future__ import annotations

from typing import Generic, TypeVar

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.task import Future

__all__ = ["FrameCollection"]

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
