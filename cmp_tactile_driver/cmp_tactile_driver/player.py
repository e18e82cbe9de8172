"""Plays a recording in its own timing, on a thread of its own, without ROS."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.pacing import Pacer
from cmp_tactile_driver.recorded_message import RecordedFrame, RecordedMessage
from cmp_tactile_driver.recording import Recording
from cmp_tactile_driver.worker import Worker

__all__ = ["PlayOptions", "Player", "PlayerState", "Progress", "StartGate"]

SETTLE_TIME = 0.2
"""After the last subscriber was matched, s: its side of the match may still be under way."""
POLL_TIME = 0.02


class PlayerState(Enum):
    """What the player does; FINISHED and FAILED are final."""

    WAITING = "waiting for subscribers"
    PLAYING = "playing"
    PAUSED = "paused"
    FINISHED = "finished"
    FAILED = "failed"
    STOPPED = "stopped"


@dataclass(frozen=True)
class PlayOptions:
    """How to play.

    rate: speed, 1 as recorded.  start: s from the beginning.  loop: for ever.  paused: at first.
    """

    rate: float = 1.0
    start: float = 0.0
    loop: bool = False
    paused: bool = False


@dataclass(frozen=True)
class StartGate:
    """Nothing is played before `is_open` or after `timeout` s, whichever comes first."""

    is_open: Callable[[], bool]
    timeout: float


@dataclass(frozen=True)
class Progress:
    """How far the player is.  frames: sent so far.  passes: through the whole recording.

    bad_frames, problem: of the recording.  max_lateness: s.
    """

    state: PlayerState
    frames: int
    passes: int
    bad_frames: int
    problem: str
    max_lateness: float


class Player:
    """Hands the messages of a recording to `send`, each at its time, none left out."""

    def __init__(
        self,
        recording: Recording,
        send: Callable[[RecordedMessage], None],
        options: PlayOptions,
        gate: StartGate | None = None,
    ) -> None:
        self._recording = recording
        self._send = send
        self._options = options
        self._gate = gate
        self._rate = options.rate
        self._pacer = Pacer()
        self._state = PlayerState.WAITING if gate else PlayerState.PLAYING
        self._frames = self._passes = 0
        self._gap = 0.0
        self._resumed = threading.Event()
        if not options.paused:
            self._resumed.set()
        self._worker = Worker("player", self._run)

    @property
    def progress(self) -> Progress:
        """A snapshot; may be asked for from any thread."""
        health, failure = self._recording.health, self._worker.failure
        state = PlayerState.FAILED if failure else self._state
        if state is PlayerState.PLAYING and not self._resumed.is_set():
            state = PlayerState.PAUSED
        return Progress(
            state,
            self._frames,
            self._passes,
            health.bad_frames,
            failure or health.problem,
            self._pacer.max_lateness,
        )

    @property
    def rate(self) -> float:
        """Speed, 1 as recorded; may be changed while playing."""
        return self._rate

    @rate.setter
    def rate(self, rate: float) -> None:
        self._rate = rate

    def start(self) -> None:
        """Begin to play."""
        self._worker.start()

    def pause(self) -> None:
        """Send nothing more after the current message."""
        self._resumed.clear()

    def resume(self) -> None:
        """Go on where it was paused."""
        self._resumed.set()

    def stop(self) -> None:
        """End, and wait for the thread; may be called more than once."""
        # A paused thread waits for this, and then sees that it is to stop.
        self._worker.request_stop()
        self._resumed.set()
        self._worker.stop()

    def _run(self) -> None:
        self._wait_for_gate()
        self._state = PlayerState.PLAYING
        while not self._worker.stopping:
            self._play_once()
            if not self._options.loop:
                break
        self._state = PlayerState.STOPPED if self._worker.stopping else PlayerState.FINISHED

    def _wait_for_gate(self) -> None:
        if self._gate is None:
            return
        deadline = time.monotonic() + self._gate.timeout
        while not self._gate.is_open():
            if self._worker.wait(POLL_TIME) or time.monotonic() > deadline:
                return
        self._worker.wait(SETTLE_TIME)

    def _play_once(self) -> None:
        begin_ns: int | None = None
        last_ns: int | None = None
        sent = 0
        for message in self._recording.messages():
            if begin_ns is None:
                begin_ns = message.time_ns + round(self._options.start * 1e9)
            if message.time_ns < begin_ns:
                continue
            elapsed = self._gap if last_ns is None else (message.time_ns - last_ns) * 1e-9
            last_ns = message.time_ns
            if not self._wait_until_due(max(0.0, elapsed)):
                return
            self._send(message)
            sent += 1
            if isinstance(message, RecordedFrame):
                self._frames += 1
            # From the end of one pass to the beginning of the next is one frame's time.
            self._gap = elapsed or self._gap
        if not sent:
            msg = f"{self._recording.name}: found no message after start = {self._options.start} s"
            raise FrameSourceError(msg)
        self._passes += 1

    def _wait_until_due(self, elapsed: float) -> bool:
        """False where the player was stopped meanwhile.  elapsed: recorded time, s."""
        if not self._resumed.is_set():
            self._resumed.wait()
            self._pacer.restart()
        return not self._worker.wait(self._pacer.delay(elapsed / self._rate))
