"""Waits for SIGINT or SIGTERM.

rclpy's own handlers end the ROS context at once, under the feet of running callbacks.  These
only tell the main thread, which then destroys what there is in order and ends the context last.
"""

from __future__ import annotations

import signal
import threading
from types import FrameType

__all__ = ["StopSignal"]


class StopSignal:
    """Set by the first SIGINT or SIGTERM.  To be made in the main thread."""

    def __init__(self) -> None:
        self._event = threading.Event()
        self._by_signal = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self._by_signal = True
        self._event.set()

    @property
    def by_signal(self) -> bool:
        """Whether a signal came."""
        return self._by_signal

    def set(self) -> None:
        """End the waiting without a signal."""
        self._event.set()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until a signal comes or `set` is called; False where neither is within timeout s."""
        return self._event.wait(timeout)
