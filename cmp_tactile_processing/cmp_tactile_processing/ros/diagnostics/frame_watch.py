"""Frames that come in or go out: losses, stamps out of order, rate, latency."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping
from enum import Enum
from typing import Any

import numpy as np

from cmp_tactile_processing.ros.wiring import Input

# An interval is a gap where it exceeds the usual one by this factor.
GAP_FACTOR = 1.6
# Gaps in a row after which they are the usual interval.
NEW_PACE = 5
SMOOTHING = 0.1
# A longer gap is to another recording, or of a clock that was set: no frames are missing in it.
LONGEST_GAP_NS = 60 * 10**9


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


class LossWatch:
    """Counts the messages that were sent to an input and never got to it.

    They show as gaps in the numbers that the middleware gives to the messages of a publisher, if
    it does.  Where frames come by a plain call, the entrance counts those that it pushed out.
    """

    def __init__(self, end: Input) -> None:
        self.end = end
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


class InputWatch(LossWatch):
    """Counts for one subscription of a stage.  newest: only the newest message is wanted."""

    def __init__(self, end: Input, *, newest: bool = False) -> None:
        super().__init__(end)
        self.stamps = StampWatch()
        self.newest = newest


# No queue of ours holds a frame that long: such stamps are of another clock.
OLDEST_S = 10.0
# A simulated clock may come after the frame that it belongs to.
EARLIEST_S = -0.1
MOST_FRAMES = 4096
# A report between two others, as after a change of state, has too few frames for a rate.
SHORTEST_S = 0.5


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
