"""Reads a frame source at its frame rate, on a thread of its own, without ROS."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from enum import Enum

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.frame_source import Frame, FrameSource
from cmp_tactile_driver.pacing import Pacer

__all__ = ["Capture", "CaptureState"]


class CaptureState(Enum):
    """What the capture does; ENDED and FAILED are final."""

    IDLE = "idle"
    RUNNING = "running"
    ENDED = "the source has ended"
    FAILED = "failed"


class Capture:
    """Hands the frames of a source to `send`, one every 1 / frame_rate s."""

    def __init__(self, source: FrameSource, send: Callable[[Frame], None]) -> None:
        self._source = source
        self._send = send
        self._stopping = threading.Event()
        self._state = CaptureState.IDLE
        self._frames = 0
        self._failure = ""
        self._thread: threading.Thread | None = None

    @property
    def state(self) -> CaptureState:
        """What it does now."""
        return self._state

    @property
    def frames(self) -> int:
        """How many frames were handed on."""
        return self._frames

    @property
    def failure(self) -> str:
        """Why it failed; empty while it did not."""
        return self._failure

    def start(self) -> None:
        """Begin, or go on after `stop` where the source was left."""
        self._stopping.clear()
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop, and wait for the thread; may be called more than once."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        self._state = CaptureState.RUNNING
        pacer = Pacer()
        try:
            while not self._stopping.is_set():
                frame = self._source.read()
                if frame is None:
                    self._state = CaptureState.ENDED
                    return
                if self._stopping.wait(pacer.delay(1 / self._source.frame_rate)):
                    break
                self._send(frame)
                self._frames += 1
            self._state = CaptureState.IDLE
        except FrameSourceError as error:
            self._fail(str(error))
        except Exception as error:  # noqa: BLE001  the node must learn of it, whatever it is
            traceback.print_exc()
            self._fail(f"{type(error).__name__}: {error}")

    def _fail(self, reason: str) -> None:
        self._failure = reason
        self._state = CaptureState.FAILED
