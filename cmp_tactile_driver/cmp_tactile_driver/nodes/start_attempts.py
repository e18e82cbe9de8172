"""Starts a node that manages its lifecycle by itself, again while what it needs is not there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from cmp_tactile_driver.sources.back_off import BackOff

__all__ = ["StartAttempts"]


class StartAttempts:
    """Calls `attempt` now and after ever longer times, on the node's executor, until it is True."""

    def __init__(self, node: Node, attempt: Callable[[], bool], back_off: BackOff) -> None:
        self._node, self._attempt, self._back_off = node, attempt, back_off
        self._timer: Any = None

    @property
    def pending(self) -> bool:
        """Whether there will be another one."""
        return self._timer is not None

    def begin(self) -> None:
        """Make the first attempt."""
        self.stop()
        if self._attempt():
            return
        # Steady: a simulated clock may stand still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self._node.create_timer(self._back_off.delay, self.begin, clock=steady)
        self._back_off.wait_longer()

    def stop(self) -> None:
        """Make no other one."""
        timer, self._timer = self._timer, None
        if timer is not None:
            self._node.destroy_timer(timer)
