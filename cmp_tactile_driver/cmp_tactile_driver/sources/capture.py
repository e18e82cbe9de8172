"""Reads a frame source on a thread of its own, in its pace; threads and waiting times."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable
from enum import Enum

from cmp_tactile_driver.sources.frames import Frame, FrameSource, SelfPacedSource
from cmp_tactile_processing.errors import CmpTactileError

POLL_S = 0.1
"""After how long without a frame it looks whether it is to stop."""
CATCH_UP = 0.02
"""How much lateness may be made good by shortening intervals, s."""
READINGS = 5


class BackOff:
    """delay: time before the next attempt, s; `first`, doubled after each up to ten times that."""

    def __init__(self, first: float) -> None:
        self._first = first
        self.delay = first

    def wait_longer(self) -> None:
        """An attempt failed."""
        self.delay = min(2 * self.delay, 10 * self._first)

    def reset(self) -> None:
        """An attempt worked."""
        self.delay = self._first


class Pacer:
    """Determines how long to wait before each event.

    An event that is late moves those after it instead of letting them follow in a bunch, which
    would overrun the queues of subscribers.

    max_lateness: by how much the latest event missed its time, s.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._due: float | None = None
        self.max_lateness = 0.0

    def restart(self) -> None:
        """Let the next event be due at once, as after a pause."""
        self._due = None

    def delay(self, interval: float) -> float:
        """Seconds to wait for an event that follows `interval` s after the last one."""
        now = self._clock()
        if self._due is None:
            self._due = now
            return 0.0
        due = self._due + interval
        self.max_lateness = max(self.max_lateness, now - due)
        self._due = max(due, now - CATCH_UP)
        return max(0.0, self._due - now)


def on_clock(
    monotonic_ns: int, other: Callable[[], int], monotonic: Callable[[], int] = time.monotonic_ns
) -> int:
    """A time of the monotonic clock on another clock, ns.

    By the reading of both clocks that was interrupted least of a few.
    """
    readings = []
    for _ in range(READINGS):
        before, there, after = monotonic(), other(), monotonic()
        readings.append((after - before, there - (before + after) // 2))
    return monotonic_ns + min(readings)[1]


class Worker:
    """Runs `work` on a thread of its own; `work` is to return soon after `stopping` is true.

    failure: why it failed, in one line; empty while it did not.
    """

    def __init__(self, name: str, work: Callable[[], None]) -> None:
        self._name = name
        self._work = work
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self.failure = ""

    @property
    def stopping(self) -> bool:
        """Whether it is to stop."""
        return self._stopping.is_set()

    def wait(self, duration: float) -> bool:
        """Pause the work for so many seconds, less where it is to stop; whether it is."""
        return self._stopping.wait(duration)

    def start(self) -> None:
        """Begin; may be called again after `stop`."""
        self._stopping.clear()
        self.failure = ""
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._thread.start()

    def request_stop(self) -> None:
        """Ask it to stop, without waiting."""
        self._stopping.set()

    def stop(self) -> None:
        """Stop, and wait for the thread unless it is the caller; may be called more than once."""
        self._stopping.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        try:
            self._work()
        except CmpTactileError as error:
            self.failure = str(error)
        except Exception as error:  # noqa: BLE001  the owner must learn of it, whatever it is
            traceback.print_exc()
            self.failure = f"{type(error).__name__}: {error}"


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
