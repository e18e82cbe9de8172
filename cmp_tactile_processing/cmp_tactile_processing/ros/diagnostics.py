"""The status of a node on /diagnostics: level, a sentence, and figures of frames in and out."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from enum import Enum
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.node import Node

from cmp_tactile_processing.errors import Finding, Severity
from cmp_tactile_processing.measured import NS_PER_S
from cmp_tactile_processing.ros.wiring import Input

# An interval is a gap where it exceeds the usual one by this factor.
GAP_FACTOR = 1.6
# Gaps in a row after which they are the usual interval.
NEW_PACE = 5
SMOOTHING = 0.1
# A longer gap is to another recording, or of a clock that was set: no frames are missing in it.
LONGEST_GAP_NS = 60 * NS_PER_S
# Share of a second's frames above which losses are warned of.
DROPPED_WARN = 0.01
# A source without a frame for so long is silent; a slow one after so many times the pause before
# its last frame.
SILENT_S, TIMES_USUAL = 3.0, 2

# No queue of ours holds a frame that long: such stamps are of another clock.
OLDEST_S = 10.0
# A simulated clock may come after the frame that it belongs to.
EARLIEST_S = -0.1
MOST_FRAMES = 4096
# A report between two others, as after a change of state, has too few frames for a rate.
SHORTEST_S = 0.5


class Stamp(Enum):
    """What a message's stamp is to that of the message before."""

    LATER = "later"
    BACK = "back"
    REPEATED = "repeated"
    ZERO = "zero"


class StampWatch:
    """Counts the stamps of one stream; `take` once per frame, in the order in which they come.

    stamps: how often each kind of stamp came.  missing: frames that should have been in the gaps
    between stamps.
    """

    def __init__(self) -> None:
        self.missing = 0
        self.stamps = dict.fromkeys(Stamp, 0)
        self._stamp_ns = 0
        self._interval_ns = 0.0
        self._gaps = 0

    def take(self, stamp_ns: int) -> Stamp:
        """Take a frame into account."""
        kind = self._kind(stamp_ns)
        self.stamps[kind] += 1
        return kind

    def _kind(self, stamp_ns: int) -> Stamp:
        if stamp_ns == 0:
            return Stamp.ZERO
        passed, self._stamp_ns = stamp_ns - self._stamp_ns, stamp_ns
        if passed == 0:
            return Stamp.REPEATED
        if passed < 0:
            self._gaps = 0
            return Stamp.BACK
        if passed < min(stamp_ns, LONGEST_GAP_NS):  # before the first frame is no interval
            self._pace(passed)
        return Stamp.LATER

    def _pace(self, passed_ns: int) -> None:
        usual = self._interval_ns
        if usual and passed_ns > usual * GAP_FACTOR:
            self.missing += round(passed_ns / usual) - 1
            self._gaps += 1
            if self._gaps < NEW_PACE:
                return
            usual = 0.0
        self._gaps = 0
        self._interval_ns = usual + SMOOTHING * (passed_ns - usual) if usual else float(passed_ns)


class InputWatch:
    """Counts the stamps of an input, and the messages that were sent to it and never got there.

    Losses show as gaps in the numbers that the middleware gives to the messages of a publisher, if
    it does.  Where frames come by a plain call, the queue counts those that it pushed out.

    newest: only the newest message is wanted.
    """

    def __init__(self, end: Input, *, newest: bool = False) -> None:
        self.end, self.newest = end, newest
        self.stamps = StampWatch()
        self._lost = 0
        self._numbers: dict[bytes, int] = {}
        self._in_order = True

    @property
    def lost(self) -> int:
        """Messages, since the start."""
        return self._lost + self.end.dropped

    def take(self, info: Mapping[str, Any] | None) -> None:
        """Take a message into account; info: rclpy's, None for what came by a plain call."""
        number = info.get("publication_sequence_number") if info is not None else None
        if info is None or number is None:
            return
        # ROS 2 Jazzy does not name the publisher: numbers of two of them go up and down by turns.
        publisher = (info.get("publisher_gid") or {}).get("data", b"")
        last = self._numbers.get(publisher)
        if last is not None:
            if number > last + 1 and self._in_order:
                self._lost += number - last - 1
            self._in_order = number > last and (self._in_order or number == last + 1)
        self._numbers[publisher] = number


class SentFrames:
    """Counts what is sent; the figures have the same names in every node.

    `sent` may be called by another thread than the rest.
    """

    def __init__(self) -> None:
        self.frames = 0
        self._ages: deque[float] = deque(maxlen=MOST_FRAMES)
        self._frames_before, self._since = 0, time.monotonic()
        self._figures: dict[str, object] = {}

    def sent(self, age_s: float = math.nan) -> None:
        """A frame was sent, so long after its stamp; NaN: not known."""
        self.frames += 1
        if not math.isnan(age_s):
            self._ages.append(age_s)

    def close_period(self) -> dict[str, object]:
        """Rate, and median and 99th percentile of the latency, since the last call."""
        now = time.monotonic()
        if self._figures and now - self._since < SHORTEST_S:
            return self._figures
        rate = (self.frames - self._frames_before) / max(now - self._since, 1e-9)
        ages = [self._ages.popleft() for _ in range(len(self._ages))]
        self._frames_before, self._since = self.frames, now
        self._figures = {"rate (Hz)": f"{rate:.2f}", **_latency(ages)}
        return self._figures


def _latency(ages_s: list[float]) -> dict[str, object]:
    median = high = "no frames"
    if ages_s:
        middle, late = np.percentile(ages_s, (50, 99))
        median, high = f"{middle * 1e3:.1f}", f"{late * 1e3:.1f}"
        if not EARLIEST_S < middle < OLDEST_S:
            median = high = (
                f"not known: stamps differ from the clock by {-middle:+.0f} s, as in a replay "
                "without /clock"
            )
    return {"latency median (ms)": median, "latency p99 (ms)": high}


def summary(findings: Iterable[Finding], otherwise: str) -> Finding:
    """All in one: the worst severity, and the texts, worst first; `otherwise` if there are none."""
    found = [item for item in findings if item.text]
    ordered = sorted(found, key=lambda item: item.severity, reverse=True)
    severity = ordered[0].severity if ordered else Severity.OK
    return Finding(severity, "; ".join(dict.fromkeys(item.text for item in ordered)) or otherwise)


def status_name(node: Node) -> str:
    """Under which a node reports: its full name without the slash that it begins with."""
    return node.get_fully_qualified_name().lstrip("/")


def status_message(
    name: str, hardware_id: str, finding: Finding, values: Mapping[str, object]
) -> DiagnosticStatus:
    """A status."""
    return DiagnosticStatus(
        level=bytes([finding.severity]),
        name=name,
        message=finding.text,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
    )


STAMP_FAULTS = {Stamp.REPEATED: "came twice", Stamp.ZERO: "were 0"}


class StageDiagnostics:
    """Counts frames and remembers the last error; `report` closes one period.

    inputs: what is known of each input.  `failure` holds the text of a lasting failure, empty while
    the stage can work; `note` what the stage makes of its results; `extra` further
    figures of it by name; `unpublished` input topics that nobody publishes.
    """

    def __init__(self) -> None:
        self.inputs: list[InputWatch] = []
        self.sent = SentFrames()
        self.frames_in = 0
        self.bad_frames = 0
        self.passed_over = 0
        self.started_again = 0
        self.last_error = ""
        self.failure = ""
        self.note = Finding(Severity.OK, "")
        self.unpublished: list[str] = []
        self.extra: dict[str, object] = {}
        self._before = dict.fromkeys(self._counts(), 0)
        self._last_frame_s = time.monotonic()
        self._silence_s = self._usual_silence_s = 0.0

    def bad_frame(self, error: str) -> None:
        """A message could not be used."""
        self.bad_frames += 1
        self.last_error = error

    def report(self) -> tuple[dict[str, object], list[Finding]]:
        """Figures of the stage by name, and what is to be reported."""
        counts = self._counts()
        new = {key: count - self._before[key] for key, count in counts.items()}
        self._before = counts
        now_s = time.monotonic()
        self._silence_s = now_s - self._last_frame_s
        if new["frames in"]:
            self._usual_silence_s, self._silence_s = self._silence_s, 0.0
            self._last_frame_s = now_s
        values = {
            **counts,
            **self.sent.close_period(),
            "started again": self.started_again,
            "last error": self.last_error,
            **self.extra,
        }
        return values, list(self._findings(new))

    def _counts(self) -> dict[str, int]:
        newer = sum(item.lost for item in self.inputs if item.newest)
        stamps = [item.stamps for item in self.inputs]
        return {
            "frames in": self.frames_in,
            "frames out": self.sent.frames,
            "bad frames": self.bad_frames,
            "lost on the way": sum(item.lost for item in self.inputs if not item.newest),
            "passed over": self.passed_over + newer,
            "missing frames": sum(item.missing for item in stamps),
            **{
                f"stamps {kind.value}": sum(item.stamps[kind] for item in stamps)
                for kind in (Stamp.BACK, *STAMP_FAULTS)
            },
        }

    def _findings(self, new: Mapping[str, int]) -> Iterator[Finding]:
        if self.failure:
            yield Finding(Severity.ERROR, self.failure)
            return
        longest_s = max(SILENT_S, TIMES_USUAL * self._usual_silence_s)
        if self._silence_s >= longest_s or not self.frames_in:
            why = f": no publisher of {', '.join(self.unpublished)}" if self.unpublished else ""
            yield Finding(Severity.WARNING, f"no frames received{why}")
            return
        if new["bad frames"]:
            text = f"{new['bad frames']} bad frames, last: {self.last_error}"
            yield Finding(Severity.WARNING, text)
        yield self.note
        for kind, fault in STAMP_FAULTS.items():
            if count := new[f"stamps {kind.value}"]:
                yield Finding(Severity.WARNING, f"stamps {fault} ({count} in the last second)")
        lost, passed_over = new["lost on the way"], new["passed over"]
        if lost + passed_over > DROPPED_WARN * (new["frames in"] + lost):
            received = new["frames in"]
            text = f"{lost} frames lost on the way, {passed_over} passed over, {received} received"
            yield Finding(Severity.WARNING, text)
