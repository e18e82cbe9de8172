"""What comes in and goes out: losses, queues, stamps out of order, latency, the tracked pattern.

`DiagnosticsParameters` says from where on it is warned of.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.ros.wiring import Input
from cmp_tactile_processing.sensor.parameters import check_parameters, parameter

SECTION = "diagnostics"
# The first must not exceed the second.
ORDERED = (
    ("rate_error", "rate_warn"),
    ("late_warn", "late_error"),
    ("dropped_warn", "dropped_error"),
    ("tracked_error", "tracked_warn"),
    ("lost_below", "found_from"),
)


@dataclass(frozen=True)
class DiagnosticsParameters:
    """Thresholds of the diagnostics, the same in every node; shares are of one second's frames."""

    rate_warn: float = parameter(
        0.0,
        "rate of results below which it is warned of; 0: any will do",
        unit="Hz",
        within=(0.0, None),
    )
    rate_error: float = parameter(
        0.0, "rate of results below which it is an error; 0: none is", unit="Hz", within=(0.0, None)
    )
    late_after: float = parameter(
        0.1, "age of its camera frame from which on a result is late", unit="s", within=(1e-3, 10.0)
    )
    late_warn: float = parameter(
        0.05, "share of late results above which it is warned of", within=(0.0, 1.0)
    )
    late_error: float = parameter(
        1.0, "share of late results above which it is an error", within=(0.0, 1.0)
    )
    dropped_warn: float = parameter(
        0.01, "share of dropped frames above which it is warned of", within=(0.0, 1.0)
    )
    dropped_error: float = parameter(
        0.5, "share of dropped frames above which it is an error", within=(0.0, 1.0)
    )
    missing_warn: float = parameter(
        0.1,
        "share of frames missing in what the camera sends above which the view splitter warns",
        within=(0.0, 1.0),
    )
    queue_warn: float = parameter(
        0.5, "share of the input queue that waits above which it is warned of", within=(0.0, 1.0)
    )
    tracked_warn: float = parameter(
        0.5, "tracked fraction of the pattern below which it is warned of", within=(0.0, 1.0)
    )
    tracked_error: float = parameter(
        0.0, "tracked fraction of the pattern below which it is an error", within=(0.0, 1.0)
    )
    lost_below: float = parameter(
        0.1, "tracked fraction below which the pattern counts as lost", within=(0.0, 1.0)
    )
    found_from: float = parameter(
        0.3, "tracked fraction from which on it counts as found again", within=(0.0, 1.0)
    )
    losses_warn: int = parameter(
        5,
        "losses of the pattern within a minute from which on it is warned of; 0: none is",
        within=(0, 1000),
    )
    calibration_age_warn: float = parameter(
        365.0,
        "age of the calibration above which it is warned of; 0: any will do",
        unit="d",
        within=(0.0, 36500.0),
    )
    report_after: int = parameter(
        2, "reports in a row beyond a threshold before that is reported", within=(1, 60)
    )
    clear_after: int = parameter(
        3, "reports in a row within it before that is no longer reported", within=(1, 60)
    )

    def __post_init__(self) -> None:
        check_parameters(self, SECTION)
        for lesser, greater in ORDERED:
            found, limit = getattr(self, lesser), getattr(self, greater)
            if found > limit:
                msg = (
                    f"{SECTION}.{lesser}: found {found!r}, expected at most "
                    f"{SECTION}.{greater}, {limit!r}"
                )
                raise ParameterError(msg)


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
        if passed < stamp_ns:  # else it is the first
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


NS_PER_S = 1e9
# Publishers whose numbers are remembered; more come and go over a long run.
MOST_PUBLISHERS = 16


class InputWatch(StampWatch):
    """Counts for one subscription; `take_message` once per message, in the order of the callbacks.

    newest: only the newest message is wanted.
    end: where frames come by a plain call, it knows queue and losses of the entrance.
    """

    def __init__(self, topic: str, depth: int, *, newest: bool = False) -> None:
        super().__init__()
        self.topic = topic
        self._newest = newest
        self.depth = depth
        self.end: Input | None = None
        self.received = 0
        self._lost = 0
        self._numbers: dict[bytes, int] = {}
        self._in_order = True
        self._waited_ns = 0

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

    def add_lost(self, count: int) -> None:
        """Messages were lost, as the middleware says."""
        self._lost += count

    def take_message(self, stamp_ns: int, info: Mapping[str, Any] | None) -> Stamp:
        """Take a message into account; stamp_ns: of its header; info: rclpy's of the message."""
        self.received += 1
        if info is not None:
            self._number(info)
            received_ns = info["received_timestamp"]
            if received_ns:
                self._waited_ns = max(self._waited_ns, time.time_ns() - received_ns)
        return self.take(stamp_ns, self._never_taken)

    def waiting(self, rate: float) -> float:
        """How many messages waited at most since the last call; rate: at which they come, Hz.

        Over DDS from the time that a message waited.
        """
        waited_s, self._waited_ns = self._waited_ns / NS_PER_S, 0
        queued = 0 if self.end is None else self.end.queued
        return max(float(queued), min(waited_s * rate, float(self.depth)))

    def _number(self, info: Mapping[str, Any]) -> None:
        number = info.get("publication_sequence_number")
        if number is None:
            return
        # ROS 2 Jazzy does not name the publisher.
        key = (info.get("publisher_gid") or {}).get("data", b"")
        last = self._numbers.get(key)
        if last is None and len(self._numbers) == MOST_PUBLISHERS:
            self._numbers.clear()
        elif last is not None:
            # Numbers of two unknown publishers go up and down by turns.
            if number > last + 1 and self._in_order:
                self._lost += number - last - 1
            self._in_order = number > last and (self._in_order or number == last + 1)
        self._numbers[key] = number


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

    @property
    def known(self) -> bool:
        """Whether the age of this period's frames is known."""
        return len(self._ages) > self._other_clock

    def figures(self) -> dict[str, object]:
        """Median and 99th percentile of the period, or why they are not known."""
        if self.known:
            median, high = np.percentile(self._ages, (50, 99)) * 1e3
            return {"latency median (ms)": f"{median:.1f}", "latency p99 (ms)": f"{high:.1f}"}
        text = "no frames"
        if self._other_clock:
            off = -self._last_age
            text = (
                f"not known: stamps are {off:+.0f} s off the clock, as in a replay without /clock"
            )
        return {"latency median (ms)": text, "latency p99 (ms)": text}

    def close_period(self) -> None:
        """Begin the next."""
        self._ages.clear()
        self._other_clock = 0


MEMORY_S = 60.0
MOST_LOSSES = 1001


class PatternWatch:
    """Follows the tracked fraction of the frames; `fraction` is the last one, NaN before it."""

    def __init__(self) -> None:
        self.fraction = math.nan
        self.losses = 0
        self.found = 0
        self._is_lost = False
        self._recent: deque[float] = deque(maxlen=MOST_LOSSES)

    def add(self, fraction: float, lost_below: float, found_from: float) -> None:
        """The share of the pattern that a frame shows; before it is found first it is not lost."""
        seen_before = not math.isnan(self.fraction)
        self.fraction = fraction
        if self._is_lost:
            if fraction >= found_from:
                self._is_lost = False
                self.found += 1
        elif fraction < lost_below:
            self._is_lost = True
            if seen_before:
                self.losses += 1
                self._recent.append(time.monotonic())

    def lost_lately(self) -> int:
        """How often it was lost within the last minute."""
        while self._recent and time.monotonic() - self._recent[0] > MEMORY_S:
            self._recent.popleft()
        return len(self._recent)
