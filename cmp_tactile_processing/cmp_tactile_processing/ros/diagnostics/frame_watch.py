"""Frames that come in or go out: losses, stamps out of order, latency."""

from __future__ import annotations

import math
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


class Stamp(Enum):
    """What a message's stamp is to that of the message before."""

    LATER = "later"
    BACK = "back"
    REPEATED = "repeated"
    ZERO = "zero"


class StampWatch:
    """Counts the stamps of one stream; `take` once per frame, in the order in which they come.

    stamps: how often each kind of stamp came; missing: further frames that gaps between stamps
    speak of.
    """

    longest_gap_ns = math.inf
    """A longer gap misses no frames."""

    def __init__(self) -> None:
        self.missing = 0
        self.stamps = dict.fromkeys(Stamp, 0)
        self._lost_before = 0
        self._stamp_ns = 0
        self._interval_ns = 0.0
        self._gaps = 0

    def take(self, stamp_ns: int, lost: int = 0) -> Stamp:
        """Take a frame into account.  lost: frames that are known to be lost until now."""
        kind = self._kind(stamp_ns, lost)
        self.stamps[kind] += 1
        return kind

    def _kind(self, stamp_ns: int, lost: int) -> Stamp:
        if stamp_ns == 0:
            return Stamp.ZERO
        passed, self._stamp_ns = stamp_ns - self._stamp_ns, stamp_ns
        if passed == 0:
            return Stamp.REPEATED
        if passed < 0:
            self._gaps = 0
            return Stamp.BACK
        if passed < min(stamp_ns, self.longest_gap_ns):  # before the first frame is no interval
            self._pace(passed, lost - self._lost_before)
            self._lost_before = lost
        return Stamp.LATER

    def _pace(self, passed_ns: int, lost: int) -> None:
        usual = self._interval_ns
        if usual and passed_ns > usual * GAP_FACTOR:
            self.missing += max(0, round(passed_ns / usual) - 1 - lost)
            if lost:
                return
            self._gaps += 1
            if self._gaps < NEW_PACE:
                return
            usual = 0.0
        self._gaps = 0
        self._interval_ns = usual + SMOOTHING * (passed_ns - usual) if usual else float(passed_ns)


# Publishers whose numbers are remembered; more come and go over a long run.
MOST_PUBLISHERS = 16


class InputWatch(StampWatch):
    """Counts for one subscription; `take_message` once per message, in the order of the callbacks.

    topic: of the subscription.  newest: only the newest message is wanted.
    end: where frames come by a plain call, it knows the losses of the entrance.
    """

    # A longer gap is to another recording, or of a clock that was set.
    longest_gap_ns = 60e9

    def __init__(self, topic: str = "", *, newest: bool = False) -> None:
        super().__init__()
        self.topic = topic
        self._newest = newest
        self.end: Input | None = None
        self._lost = 0
        self._numbers: dict[bytes, int] = {}
        self._in_order = True
        self._publisher, self._returns = b"", 0

    @property
    def lost(self) -> int:
        """Messages lost on the way or pushed out of the queue, since the start."""
        return 0 if self._newest else self._never_taken

    @property
    def passed_over(self) -> int:
        """Messages that newer ones took the place of, since the start."""
        return self._never_taken if self._newest else 0

    @property
    def _never_taken(self) -> int:
        return self._lost + (0 if self.end is None else self.end.dropped)

    def take_mixed(self) -> bool:
        """Whether publishers took turns since the last call; one that follows another does not."""
        returns, self._returns = self._returns, 0
        return returns > 1

    def add_lost(self, count: int) -> None:
        """Messages were lost, as the middleware says."""
        self._lost += count

    def take_message(self, stamp_ns: int, info: Mapping[str, Any] | None) -> Stamp:
        """Take a message into account; stamp_ns: of its header; info: rclpy's of the message."""
        number = info.get("publication_sequence_number") if info is not None else None
        if info is not None and number is not None:
            # ROS 2 Jazzy does not name the publisher.
            self._number((info.get("publisher_gid") or {}).get("data", b""), number)
        return self.take(stamp_ns, self._never_taken)

    def _number(self, publisher: bytes, number: int) -> None:
        last = self._numbers.get(publisher)
        if last is None and len(self._numbers) == MOST_PUBLISHERS:
            self._numbers.clear()
        elif last is not None:
            # Numbers of two unknown publishers go up and down by turns.
            if number > last + 1 and self._in_order:
                self._lost += number - last - 1
            self._in_order = number > last and (self._in_order or number == last + 1)
            self._returns += publisher != self._publisher
        self._publisher = publisher
        self._numbers[publisher] = number


# No queue of ours holds a frame that long: such stamps are of another clock.
OLDEST_S = 10.0
# A simulated clock may come after the frame that it belongs to.
EARLIEST_S = -0.1
MOST_FRAMES = 4096


class LatencyWatch:
    """Ages of the results since the last `close_period`, and how many were late since the start."""

    def __init__(self) -> None:
        self.late = 0
        self._ages: deque[float] = deque(maxlen=MOST_FRAMES)
        self._other_clock = 0
        self._last_age = math.nan

    def add(self, age_s: float, late_after: float) -> None:
        """A result of a camera frame that was stamped `age_s` ago; NaN: not known."""
        if EARLIEST_S < age_s < OLDEST_S:
            self._ages.append(max(age_s, 0.0))
            self.late += age_s > late_after
        elif age_s == age_s:  # noqa: PLR0124  not NaN
            self._other_clock += 1
            self._last_age = age_s

    def figures(self) -> dict[str, object]:
        """Median and 99th percentile of the period, or why they are not known."""
        if len(self._ages) > self._other_clock:
            median, high = np.percentile(self._ages, (50, 99)) * 1e3
            return {"latency median (ms)": f"{median:.1f}", "latency p99 (ms)": f"{high:.1f}"}
        text = "no frames"
        if self._other_clock:
            off = -self._last_age
            text = (
                f"not known: stamps differ from the clock by {off:+.0f} s, as in a replay without "
                "/clock"
            )
        return {"latency median (ms)": text, "latency p99 (ms)": text}

    def close_period(self) -> None:
        """Begin the next."""
        self._ages.clear()
        self._other_clock = 0
