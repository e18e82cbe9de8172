"""Draws at most so often, and never leaves the newest undrawn."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

__all__ = ["DrawingRate"]

NS_PER_S = 1_000_000_000


class DrawingRate:
    """Calls `draw` when asked; of what is asked for too early, once more when the time has come.

    People see no more than some 20 pictures a second, and frames come at 60 Hz.  Nothing runs
    while nothing is asked for.
    """

    def __init__(self, node: Node, draw: Callable[[], None], rate_hz: float) -> None:
        """rate_hz: 0 for no limit."""
        self._draw = draw
        self._waiting = False
        # Steady: a paused simulation clock must not stop it.
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(1.0, self._time_has_come, clock=clock, autostart=False)
        self.limit(rate_hz)

    def limit(self, rate_hz: float) -> None:
        """Change the rate."""
        self._limited = rate_hz > 0
        if self._limited:
            self._timer.timer_period_ns = round(NS_PER_S / rate_hz)

    def request(self) -> None:
        """Draw now or, where that would be too often, soon."""
        if not self._limited:
            self._draw()
        elif self._timer.is_canceled():
            self._timer.reset()
            self._draw()
        else:
            self._waiting = True

    def _time_has_come(self) -> None:
        if self._waiting:
            self._waiting = False
            self._draw()
        else:
            self._timer.cancel()
