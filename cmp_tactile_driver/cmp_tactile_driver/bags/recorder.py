"""Records messages on a thread of its own, from a queue that does not grow without end."""

from __future__ import annotations

import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from rosbags.interfaces import Qos

from cmp_tactile_driver.bags.writer import BagWriter
from cmp_tactile_processing.errors import CmpTactileError

SYNC_PERIOD_S = 0.5
MESSAGE_LIMIT = 20_000


class RecorderState(Enum):
    """What a recorder does; FINISHED and FAILED are final."""

    RECORDING = "recording"
    FINISHED = "finished"
    FAILED = "failed"


@dataclass(frozen=True)
class EncodedMessage:
    """What goes to the bag: topic, type and CDR bytes."""

    topic: str
    kind: str
    data: bytes


@dataclass
class Tap:
    """A topic that is recorded.

    encode: makes bytes of a message, on the recorder's thread.  qos: of its publishers.
    size: bytes that the last message took in the bag; the next one waiting counts as much.
    """

    topic: str
    encode: Callable[[Any], EncodedMessage]
    qos: Sequence[Qos] = ()
    size: int = 1000


@dataclass(frozen=True)
class RecordingProgress:
    """How far a recording is.

    messages: on the disk, by topic as it is in the bag.  dropped: by topic, because the queue was
    full, they could not be encoded or written or did not come.  problem: the last.  queued_bytes:
    what waits.
    """

    state: RecorderState
    messages: dict[str, int]
    dropped: dict[str, int]
    problem: str
    size: int
    duration_s: float
    queued_bytes: int

    @property
    def is_over(self) -> bool:
        """Whether nothing more is written."""
        return self.state is not RecorderState.RECORDING

    @property
    def has_failed(self) -> bool:
        """Whether it ended early, or its index is missing."""
        return self.state is RecorderState.FAILED


class BagRecorder:
    """Writes what `put` brings; never waits for the disk in `put`."""

    def __init__(self, writer: BagWriter, queue_bytes: int) -> None:
        """queue_bytes: what may wait; what comes while it is full is dropped, and counted."""
        self._writer = writer
        self._queue: deque[tuple[Tap, int, Any, int]] = deque()
        self._limit_bytes = queue_bytes
        self._queued_bytes = 0
        self._condition = threading.Condition()
        self._stopping = False
        self._state = RecorderState.RECORDING
        self._messages: Counter[str] = Counter()
        self._unsynced: Counter[str] = Counter()
        self._dropped: Counter[str] = Counter()
        self._problem = ""
        self._first_ns = self._last_ns = 0
        self._size = 0
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    @property
    def progress(self) -> RecordingProgress:
        """A snapshot; from any thread."""
        with self._condition:
            return RecordingProgress(
                self._state,
                dict(self._messages),
                dict(self._dropped),
                self._problem,
                self._size,
                (self._last_ns - self._first_ns) * 1e-9,
                self._queued_bytes,
            )

    def put(self, tap: Tap, log_ns: int, message: Any) -> None:
        """Hand a message over, which nobody may change any more."""
        size = max(len(getattr(message, "data", ())), tap.size)
        with self._condition:
            if self._state is RecorderState.FAILED:
                self._dropped[tap.topic] += 1
            if self._state is not RecorderState.RECORDING or self._stopping:
                return
            queued = self._queued_bytes + size
            if queued > self._limit_bytes or len(self._queue) >= MESSAGE_LIMIT:
                self._drop(tap, 1, "dropped, because writing is too slow")
                return
            self._queue.append((tap, log_ns, message, size))
            self._queued_bytes = queued
            self._condition.notify()

    def lost(self, tap: Tap, count: int) -> None:
        """Count messages that did not come as far as `put`."""
        with self._condition:
            self._drop(tap, count, "lost on the way to the recorder")

    def stop(self) -> None:
        """Write what waits, close the bag, and wait for that; may be called more than once."""
        with self._condition:
            self._stopping = True
            self._condition.notify()
        self._thread.join()

    def _drop(self, tap: Tap, count: int, reason: object) -> None:
        self._dropped[tap.topic] += count
        self._problem = f"{tap.topic}: {reason}"

    def _run(self) -> None:
        problem = ""
        for step in (self._write_all, self._writer.close):
            try:
                step()
            except CmpTactileError as error:  # noqa: PERF203  one after the other
                problem = problem or str(error)
            except Exception as error:  # noqa: BLE001  whoever watches must learn of it
                traceback.print_exc()
                problem = problem or f"{type(error).__name__}: {error}"
        with self._condition:
            # What was written last may have found no room on the disk.
            (self._dropped if problem else self._messages).update(self._unsynced)
            self._size = self._writer.size
            self._state = RecorderState.FAILED if problem else RecorderState.FINISHED
            self._problem = problem or self._problem
            self._dropped.update(tap.topic for tap, *_ in self._queue)
            self._queue.clear()
            self._queued_bytes = 0

    def _write_all(self) -> None:
        sync_at = time.monotonic() + SYNC_PERIOD_S
        while True:
            with self._condition:
                self._condition.wait_for(
                    lambda: self._queue or self._stopping,
                    max(0.0, sync_at - time.monotonic()),
                )
                item = self._queue.popleft() if self._queue else None
                ends = self._stopping and item is None
            if ends:
                return
            if item is not None:
                self._write(*item)
            if time.monotonic() >= sync_at:
                self._sync()
                sync_at = time.monotonic() + SYNC_PERIOD_S

    def _sync(self) -> None:
        """Close the chunk, and count what is in it."""
        self._writer.sync()
        with self._condition:
            self._size = self._writer.size
            self._messages += self._unsynced
            self._unsynced.clear()

    def _write(self, tap: Tap, log_ns: int, message: Any, size: int) -> None:
        try:
            encoded = tap.encode(message)
            self._writer.add_topic(encoded.topic, encoded.kind, tap.qos)
        except Exception as error:  # noqa: BLE001  one message must not end the recording
            with self._condition:
                self._drop(tap, 1, error)
                self._queued_bytes -= size
            return
        tap.size = len(encoded.data)
        self._unsynced[encoded.topic] += 1
        self._writer.write(encoded.topic, log_ns, encoded.data)
        with self._condition:
            self._queued_bytes -= size
            self._first_ns = self._first_ns or log_ns
            self._last_ns = max(self._last_ns, log_ns)
