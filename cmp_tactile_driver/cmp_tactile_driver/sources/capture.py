"""Reads a frame source on a thread of its own, in its pace; no ROS."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

from cmp_tactile_driver.sources.frames import Frame, FrameSource, SelfPacedSource
from cmp_tactile_driver.sources.timing import Pacer, Worker

POLL_S = 0.1
"""After how long without a frame it looks whether it is to stop."""


class CaptureState(Enum):
    """What the capture does; ENDED and FAILED are final."""

    IDLE = "idle"
    RUNNING = "running"
    ENDED = "the source has ended"
    FAILED = "failed"


class Capture:
    """Hands the frames of a source to `send`: one every 1 / frame_rate s, or each as it comes.

    frames: how many frames were handed on.
    """

    def __init__(self, source: FrameSource, send: Callable[[Frame], None]) -> None:
        self._source = source
        self._send = send
        self._worker = Worker("capture", self._run)
        self._state = CaptureState.IDLE
        self.frames = 0

    @property
    def state(self) -> CaptureState:
        """What it does now."""
        return CaptureState.FAILED if self._worker.failure else self._state

    @property
    def failure(self) -> str:
        """Why it failed; empty while it did not."""
        return self._worker.failure

    def start(self) -> None:
        """Begin, or go on after `stop` where the source was left.

        Raises FrameSourceError where a source that paces itself gives no frames.
        """
        if isinstance(self._source, SelfPacedSource):
            self._source.start()
        self._worker.start()

    def stop(self) -> None:
        """Stop, and wait for the thread; may be called more than once."""
        self._worker.stop()
        if isinstance(self._source, SelfPacedSource):
            self._source.stop()

    def _run(self) -> None:
        self._state = CaptureState.RUNNING
        if isinstance(self._source, SelfPacedSource):
            self._follow(self._source)
        else:
            self._pace()

    def _follow(self, source: SelfPacedSource) -> None:
        while not self._worker.stopping:
            frame = source.poll(POLL_S)
            if frame is not None:
                self._hand_on(frame)
        self._state = CaptureState.IDLE

    def _pace(self) -> None:
        pacer = Pacer()
        while not self._worker.stopping:
            frame = self._source.read()
            if frame is None:
                self._state = CaptureState.ENDED
                return
            if self._worker.wait(pacer.delay(1 / self._source.frame_rate)):
                break
            self._hand_on(frame)
        self._state = CaptureState.IDLE

    def _hand_on(self, frame: Frame) -> None:
        self._send(frame)
        self.frames += 1
