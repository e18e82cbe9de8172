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
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self._event.set()

    def is_set(self) -> bool:
        """Whether a signal came."""
        return self._event.is_set()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for a signal, at most `timeout` s; True if one came."""
        return self._event.wait(timeout)
