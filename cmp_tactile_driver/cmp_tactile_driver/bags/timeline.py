"""The time of a recording: seconds from its first frame, by the stamps of its messages.

When a message was received only gives its place among those without a stamp.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from statistics import median

from cmp_tactile_driver.bags.files import StoredMessage

NS_PER_S = 10**9
LONGEST_GAP_S = 60.0
"""A longer time between two messages is a jump of the clock or a pause: nobody waits for it."""
# A clock that was set back stays so; a message that came late is one of a few.
FEW = 6
SURELY_SET_BACK_S = 1.0
DEFAULT_STEP_S = 1 / 30


@dataclass(frozen=True)
class TimeSpan:
    """A part of a recording, in s from its first frame: from `start` on, before `end`."""

    start: float = 0.0
    end: float = math.inf

    def __contains__(self, time_s: float) -> bool:
        return self.start <= time_s < self.end


WHOLE = TimeSpan()


@dataclass(frozen=True)
class Timeline:
    """Messages in order.

    Their times rise, and are 0 at the first frame and for what came before it.  gaps: what was
    skipped, in one line; empty for nothing.
    """

    messages: tuple[StoredMessage, ...] = ()
    gaps: str = ""

    @property
    def duration(self) -> float:
        """Time of the last message, s."""
        return self.messages[-1].time_s if self.messages else 0.0

    def part(self, span: TimeSpan) -> tuple[StoredMessage, ...]:
        """The messages in a part of the recording."""
        first, end = (
            bisect_left(self.messages, time_s, key=lambda message: message.time_s)
            for time_s in (span.start, span.end)
        )
        return self.messages[first:end]


def timeline(messages: Sequence[StoredMessage], first_topic: str) -> Timeline:
    """Put messages in order, given as they were received; time 0 is the first of `first_topic`."""
    if not messages:
        return Timeline()
    stamps = _filled_stamps(messages)
    ordered: list[int] = []
    begins = []
    for part in _between_restarts(messages, stamps):
        begins.append(len(ordered))
        ordered += sorted(part, key=lambda number: stamps[number])
    # In ns: a sum of seconds misses a frame at 0.2 s by its last digit.
    steps = [stamps[b] - stamps[a] for a, b in pairwise(ordered)]
    longest = LONGEST_GAP_S * NS_PER_S
    usual = [step for step in steps if 0 < step <= longest]
    usual_step = round(median(usual) if usual else DEFAULT_STEP_S * NS_PER_S)
    restarts = {begin - 1 for begin in begins[1:]}
    skipped = [number in restarts or step > longest for number, step in enumerate(steps)]
    passed = [usual_step if skip else step for step, skip in zip(steps, skipped, strict=True)]
    times = list(accumulate(passed, initial=0))
    first = next((k for k, n in enumerate(ordered) if messages[n].topic == first_topic), 0)
    gaps = [step / NS_PER_S for step, skip in zip(steps, skipped, strict=True) if skip]
    return Timeline(
        tuple(
            replace(messages[number], time_s=max(0, time - times[first]) / NS_PER_S)
            for number, time in zip(ordered, times, strict=True)
        ),
        _gaps_text(gaps, messages),
    )


def _filled_stamps(messages: Sequence[StoredMessage]) -> list[int]:
    """Stamps; for a message without one, its neighbour's and the time between their receipts."""
    stamped = [number for number, message in enumerate(messages) if message.stamp_ns]
    if not stamped:
        return [message.time_ns for message in messages]
    stamps = [message.stamp_ns for message in messages]
    for number, message in enumerate(messages):
        if message.stamp_ns:
            continue
        after = bisect_left(stamped, number)
        near = messages[stamped[max(after - 1, 0)]]
        stamps[number] = near.stamp_ns + message.time_ns - near.time_ns
        if after < len(stamped):
            # Between its neighbours, whatever the receipts say.
            latest_ns = max(near.stamp_ns, messages[stamped[after]].stamp_ns)
            stamps[number] = min(stamps[number], latest_ns)
    return stamps


def _between_restarts(messages: Sequence[StoredMessage], stamps: Sequence[int]) -> list[range]:
    """Parts in which the clock of the stamps runs on; it was set back between them.

    Where it was, stamps stay behind the receipts by as much.  A message that came late is alone
    behind, and belongs before those that came sooner.
    """
    delays = [message.time_ns - stamp for message, stamp in zip(messages, stamps, strict=True)]
    least_after = _least_until_jump(delays)
    parts = []
    begin, newest = 0, stamps[0]
    for number, stamp in enumerate(stamps):
        fall = newest - stamp
        if fall > 0 and (len(stamps) - number >= FEW or fall >= SURELY_SET_BACK_S * NS_PER_S):
            before = median(delays[max(begin, number - FEW) : number])
            if least_after[number] >= before + fall / 2:
                parts.append(range(begin, number))
                begin, newest = number, stamp
        newest = max(newest, stamp)
    return [*parts, range(begin, len(stamps))]


def _least_until_jump(delays: Sequence[int]) -> list[int]:
    """The least of each delay and those after it, up to where the clock was set forward."""
    least = list(delays)
    for number in range(len(delays) - 2, -1, -1):
        if delays[number] - delays[number + 1] <= LONGEST_GAP_S * NS_PER_S:
            least[number] = min(least[number], least[number + 1])
    return least


def _gaps_text(gaps: Sequence[float], messages: Sequence[StoredMessage]) -> str:
    """One line on times that are skipped, or on receipts that are no guide to the time."""
    if gaps:
        longest = max(gaps, key=abs)
        return f"skipped jumps of the stamps: {len(gaps)}, the largest {longest:.6g} s"
    receipts = [message.time_ns for message in messages]
    longest = max((b - a for a, b in pairwise(receipts)), default=0)
    if longest <= LONGEST_GAP_S * NS_PER_S:
        return ""
    return f"skipped a gap of {longest / NS_PER_S:.6g} s between the times of receipt"
