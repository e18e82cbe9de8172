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
    """What goes to the bag: topic, type and CDR bytes; stamp_ns: of its header, if it has one."""

    topic: str
    kind: str
    data: bytes
    stamp_ns: int | None


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

    messages: written, by topic as it is in the bag.  dropped: by topic, because the queue was full,
    they could not be encoded or did not come.  problem: the last.  queued_bytes: what waits, and
    queue_peak_bytes the most that ever did.
    """

    state: RecorderState
    messages: dict[str, int]
    dropped: dict[str, int]
    problem: str
    size: int
    files: int
    duration_s: float
    queued_bytes: int
    queue_peak_bytes: int

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
        self._queued_bytes = self._peak_bytes = 0
        self._condition = threading.Condition()
        self._stopping = self._split_wanted = False
        self._state = RecorderState.RECORDING
        self._messages: Counter[str] = Counter()
        self._dropped: Counter[str] = Counter()
        self._problem = ""
        self._first_ns = self._last_ns = 0
        self._size, self._files = 0, 1
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
                self._files,
                (self._last_ns - self._first_ns) * 1e-9,
                self._queued_bytes,
                self._peak_bytes,
            )

    def put(self, tap: Tap, log_ns: int, message: Any) -> None:
        """Hand a message over, which nobody may change any more."""
        size = max(len(getattr(message, "data", ())), tap.size)
        with self._condition:
            if self._state is not RecorderState.RECORDING or self._stopping:
                return
            queued = self._queued_bytes + size
            if queued > self._limit_bytes or len(self._queue) >= MESSAGE_LIMIT:
                self._drop(tap, 1, "dropped, because writing is too slow")
                return
            self._queue.append((tap, log_ns, message, size))
            self._queued_bytes, self._peak_bytes = queued, max(self._peak_bytes, queued)
            self._condition.notify()

    def lost(self, tap: Tap, count: int) -> None:
        """Count messages that did not come as far as `put`."""
        with self._condition:
            self._drop(tap, count, "lost on the way to the recorder")

    def split(self) -> None:
        """Begin a new file before the next message."""
        with self._condition:
            self._split_wanted = True
            self._condition.notify()

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
            self._size, self._files = self._writer.size, self._writer.file_count
            # What was written last may have found no room on the disk.
            lost = self._messages - self._writer.counts
            self._dropped.update(lost)
            self._messages -= lost
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
                    lambda: self._queue or self._stopping or self._split_wanted,
                    max(0.0, sync_at - time.monotonic()),
                )
                split, self._split_wanted = self._split_wanted, False
                item = self._queue.popleft() if self._queue else None
                ends = self._stopping and item is None
            if split:
                self._writer.split()
            if ends:
                return
            if item is not None:
                self._write(*item)
            if time.monotonic() >= sync_at:
                self._writer.sync()
                sync_at = time.monotonic() + SYNC_PERIOD_S
            with self._condition:
                self._size, self._files = self._writer.size, self._writer.file_count

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
        with self._condition:
            # Before it is written: in the end those that the bag does not hold are taken off.
            self._messages[encoded.topic] += 1
        self._writer.write(encoded.topic, log_ns, encoded.data, encoded.stamp_ns)
        with self._condition:
            self._queued_bytes -= size
            self._first_ns = self._first_ns or log_ns
            self._last_ns = max(self._last_ns, log_ns)
