"""Plays recordings in their own timing, on a thread of its own, without ROS."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from enum import Enum
from typing import TypeVar, cast

from cmp_tactile_driver.bags.reader import RecordedFrame, RecordedMessage
from cmp_tactile_driver.bags.recording import Recording
from cmp_tactile_driver.bags.timeline import TimeSpan
from cmp_tactile_driver.sources.capture import Pacer, Worker
from cmp_tactile_driver.sources.frames import SourceHealth
from cmp_tactile_driver.sources.parameters import ReplayParameters
from cmp_tactile_processing.errors import FrameSourceError

T = TypeVar("T")

POLL_TIME = 0.02
# From the last message, in which its time is not lost by rounding.
SURELY_WITHIN_S = 1e-6
PREFETCH_DEPTH = 16
"""Messages that are read and decoded ahead: half a dozen frames or more."""


def read_ahead(items: Iterator[T], depth: int) -> Generator[T, None, None]:
    """The items in their order, up to `depth` of them read ahead on a thread.

    Ends that thread when it is closed.  What the iterator raises is raised after its last item.
    """
    end = object()
    with ThreadPoolExecutor(1, "read_ahead") as pool:
        ahead = deque(pool.submit(next, items, end) for _ in range(depth))
        try:
            while (item := ahead.popleft().result()) is not end:
                ahead.append(pool.submit(next, items, end))
                yield cast("T", item)
        finally:
            pool.shutdown(cancel_futures=True)


class PlayerState(Enum):
    """What the player does; FINISHED and FAILED are final."""

    WAITING = "waiting for subscribers"
    PLAYING = "playing"
    PAUSED = "paused"
    FINISHED = "finished"
    FAILED = "failed"
    STOPPED = "stopped"


@dataclass(frozen=True)
class StartGate:
    """Nothing is played before it opens, or `timeout` s have passed, whichever comes first.

    remaining: how long it stays closed, s; None as long as that is not known.
    give_up: is called, on the player's thread, before it plays although the gate is closed.
    """

    remaining: Callable[[], float | None]
    timeout: float
    give_up: Callable[[], None]


@dataclass(frozen=True)
class Progress:
    """How far the player is.  frames: sent so far.  passes: through the whole recording.

    health: of the recordings, silent where playing failed.  max_lateness: s.  position: of what was
    sent last, in s from the first frame.
    """

    state: PlayerState
    frames: int
    passes: int
    health: SourceHealth
    max_lateness: float
    position: float


class _Mark(Enum):
    """Between messages: no time passes from one recording to the next."""

    RECORDING_OVER = "end of a recording"
    ALL_OVER = "end of all recordings"


class Player:
    """Hands the messages of recordings to `send`, each at its time, none left out.

    Recordings follow one another with a frame's time between them, whatever their times say.

    rate: speed, 1 as recorded; may be changed while playing.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        send: Callable[[RecordedMessage], None],
        options: ReplayParameters,
        gate: StartGate | None = None,
    ) -> None:
        """options: rate, start, end, loop and paused."""
        self._recordings = recordings
        self._send = send
        self._options = options
        self._gate = gate
        self.rate = options.rate
        self._pacer = Pacer()
        self._state = PlayerState.WAITING if gate else PlayerState.PLAYING
        self._frames = self._passes = 0
        self._gap = self._position = 0.0
        self._last_s: float | None = None
        self._condition = threading.Condition()
        self._paused = options.paused
        self._steps = 0
        self._jump_to: float | None = None
        self._worker = Worker("player", self._run)

    @property
    def progress(self) -> Progress:
        """A snapshot; may be asked for from any thread."""
        health = sum((item.health for item in self._recordings), SourceHealth())
        state = self._state
        if self._worker.failure:
            state = PlayerState.FAILED
            health = replace(health, problem=self._worker.failure, silent=True)
        if state is PlayerState.PLAYING and self._paused:
            state = PlayerState.PAUSED
        return Progress(
            state,
            self._frames,
            self._passes,
            health,
            self._pacer.max_lateness,
            self._position,
        )

    @property
    def is_stopping(self) -> bool:
        """Whether nothing more is to be sent."""
        return self._worker.stopping

    def start(self) -> None:
        """Begin to play."""
        self._worker.start()

    def set_paused(self, paused: bool) -> None:
        """Send nothing more after the current message, or go on where it was paused."""
        with self._condition:
            self._paused = paused
            self._steps = 0
            self._condition.notify_all()

    def step(self) -> bool:
        """Send all up to the next frame at once; False where it is not paused."""
        with self._condition:
            if self.progress.state is not PlayerState.PAUSED:
                return False
            self._steps += 1
            self._condition.notify_all()
            return True

    def jump(self, start: float) -> None:
        """Go on from another place; start: s from the first frame."""
        with self._condition:
            self._jump_to = start
            self._condition.notify_all()

    def jump_by(self, seconds: float) -> float | None:
        """Go on from so much later, or earlier; the place, s.  None where nothing is played.

        While it is paused, the first frame of there is sent.
        """
        with self._condition:
            if self.progress.state not in (PlayerState.PLAYING, PlayerState.PAUSED):
                return None
            here = self._position if self._jump_to is None else self._jump_to
            last = sum(item.duration for item in self._recordings) - SURELY_WITHIN_S
            self._jump_to = max(0.0, min(here + seconds, last))
            self._steps = int(self._paused)
            self._condition.notify_all()
            return self._jump_to

    def stop(self) -> None:
        """End, and wait for the thread; may be called more than once."""
        self._worker.request_stop()
        with self._condition:
            self._condition.notify_all()
        self._worker.stop()

    def _run(self) -> None:
        self._wait_for_gate()
        self._state = PlayerState.PLAYING
        start = self._options.start
        while not self._worker.stopping and not self._play_from(start):
            with self._condition:
                start, self._jump_to = self._jump_to or 0.0, None
            self._last_s = None
            self._pacer.restart()
        self._state = PlayerState.STOPPED if self._worker.stopping else PlayerState.FINISHED

    def _wait_for_gate(self) -> None:
        if self._gate is None:
            return
        deadline = time.monotonic() + self._gate.timeout
        while (remaining := self._gate.remaining()) is None:
            if self._worker.wait(POLL_TIME):
                return
            if time.monotonic() > deadline:
                self._gate.give_up()
                return
        self._worker.wait(remaining)

    def _play_from(self, start: float) -> bool:
        """Whether all was played; False where it was stopped or is to jump."""
        with closing(read_ahead(self._timeline(start), PREFETCH_DEPTH)) as items:
            for item in items:
                if item is _Mark.RECORDING_OVER:
                    self._last_s = None
                elif item is _Mark.ALL_OVER:
                    self._passes += 1
                elif not self._play(*item):
                    return False
        return True

    def _timeline(self, start: float) -> Iterator[tuple[RecordedMessage, float] | _Mark]:
        """All that is to be sent, and where its recording begins, s; again where it loops."""
        end = self._options.end or math.inf
        while True:
            sent, offset = 0, 0.0
            for recording in self._recordings:
                span = TimeSpan(max(0.0, start - offset), end - offset)
                for message in recording.messages(span):
                    sent += 1
                    yield message, offset
                offset += recording.duration
                yield _Mark.RECORDING_OVER
            # Behind the end there is nothing to play, and nothing wrong.
            if not sent and start == self._options.start:
                names = ", ".join(item.name for item in self._recordings)
                msg = (
                    f"{names}: found no message after start = {start} s, expected an earlier start"
                )
                raise FrameSourceError(msg)
            yield _Mark.ALL_OVER
            if not self._options.loop:
                return
            start = self._options.start

    def _play(self, message: RecordedMessage, offset: float) -> bool:
        """False where it was stopped or is to jump.  offset: where its recording begins, s."""
        elapsed = self._gap if self._last_s is None else message.time_s - self._last_s
        self._last_s = message.time_s
        is_frame = isinstance(message, RecordedFrame)
        if not self._wait_until_due(max(0.0, elapsed), is_step=is_frame):
            return False
        self._send(message)
        self._position = offset + message.time_s
        self._frames += is_frame
        # From the end of one pass to the beginning of the next is one frame's time.
        self._gap = elapsed or self._gap
        return True

    def _wait_until_due(self, elapsed: float, *, is_step: bool) -> bool:
        """False where it was stopped or is to jump.

        elapsed: recorded time, s.  is_step: what is sent then is what one step asked for.
        """
        with self._condition:
            if self._paused:
                self._condition.wait_for(lambda: not self._paused or self._steps or self._ends)
                self._pacer.restart()
            delay = self._pacer.delay(elapsed / self.rate)
            self._condition.wait_for(lambda: self._ends, delay)
            if self._ends:
                return False
            # Before it is sent: what is asked for meanwhile is for the next one.
            self._steps = max(0, self._steps - is_step)
            return True

    @property
    def _ends(self) -> bool:
        return self._worker.stopping or self._jump_to is not None
