"""Reads a frame source on a thread of its own, in its pace; times, clocks and attempts; no ROS."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable
from enum import Enum

from cmp_tactile_driver.sources.frames import Frame, FrameSource, SelfPacedSource
from cmp_tactile_processing.errors import CmpTactileError


class BackOff:
    """delay: time before the next attempt, s; `first` to begin with, doubled up to `longest`."""

    def __init__(self, first: float, longest: float) -> None:
        self._first = first
        self._longest = max(first, longest)
        self.delay = first

    def wait_longer(self) -> None:
        """An attempt failed."""
        self.delay = min(2 * self.delay, self._longest)

    def reset(self) -> None:
        """An attempt worked."""
        self.delay = self._first


CATCH_UP = 0.02
"""How much lateness may be made good by shortening intervals, s."""


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


READINGS = 3
# A thread that is interrupted between two clocks reads an offset that is off by that long.
MAX_READING_NS = 100_000
# A clock that is set, not slewed, is followed at once.
STEP_NS = 5_000_000
# Time in which a change of the offset is followed to two thirds.
SMOOTHING_NS = 1_000_000_000


class ClockOffset:
    """The difference of two clocks, smoothed; each `convert` follows it a little.

    other, monotonic: the clocks, ns.  NTP slews a clock by 0.5 ms a second at most, so the times
    are off by less than that; of a clock that is set again, such as by the start of a recording
    with /clock, the next time is already right.
    """

    def __init__(
        self, other: Callable[[], int], monotonic: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._other = other
        self._monotonic = monotonic
        self._offset_ns: float | None = None
        self._read_ns = 0

    @property
    def offset_ns(self) -> int:
        """The other clock's time less the monotonic one's, as it was last."""
        return round(self._offset_ns or 0)

    def convert(self, monotonic_ns: int) -> int:
        """The time of the other clock, ns."""
        self._follow()
        return monotonic_ns + self.offset_ns

    def _follow(self) -> None:
        spread, offset, now = min(self._reading() for _ in range(READINGS))
        before = self._offset_ns
        if before is None or abs(offset - before) > max(STEP_NS, spread):
            self._offset_ns, self._read_ns = float(offset), now
        elif spread <= MAX_READING_NS:
            elapsed = now - self._read_ns
            share = elapsed / (elapsed + SMOOTHING_NS)
            self._offset_ns, self._read_ns = before + share * (offset - before), now

    def _reading(self) -> tuple[int, int, int]:
        before = self._monotonic()
        other = self._other()
        after = self._monotonic()
        middle = (before + after) // 2
        return after - before, other - middle, after


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
