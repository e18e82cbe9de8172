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
from cmp_tactile_processing.measured import NS_PER_S

LONGEST_GAP_S = 60.0
"""A longer time between two messages is a jump of the clock or a pause: nobody waits for it."""
# A clock that was set back stays so; a message that came late is one of a few.
FEW = 6
SURELY_SET_BACK_S = 1.0
DEFAULT_FRAME_RATE = 30.0
"""Of recordings that do not have theirs, Hz."""


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

    Their times rise, and are 0 at the first frame and for what came before it.  stamps_ns: theirs,
    which run on where the clock was set back.  gaps: what was skipped, in one line; empty for
    nothing.
    """

    messages: tuple[StoredMessage, ...] = ()
    stamps_ns: tuple[int, ...] = ()
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
    receipts = run_on([message.time_ns for message in messages])
    stamps = _filled_stamps(messages, receipts)
    ordered: list[int] = []
    for part in _between_restarts(stamps, receipts):
        ordered += sorted(part, key=lambda number: stamps[number])
    in_order = [stamps[number] for number in ordered]
    times = passed_ns(in_order)
    first = next((k for k, n in enumerate(ordered) if messages[n].topic == first_topic), 0)
    return Timeline(
        tuple(
            replace(messages[number], time_s=max(0, time - times[first]) / NS_PER_S)
            for number, time in zip(ordered, times, strict=True)
        ),
        tuple(running_ns(in_order)),
        _gaps_text(in_order, [time - times[first] for time in times], messages),
    )


def run_on(times_ns: Sequence[int]) -> list[int]:
    """Times in the order in which they were written, as if their clock had never been set back.

    A message that was written late stays where it is: the next ones are after the newest again.
    """
    usual = _usual_step([b - a for a, b in pairwise(times_ns)])
    found = []
    offset, newest = 0, times_ns[0] if times_ns else 0
    for number, time_ns in enumerate(times_ns):
        fall, after = newest - time_ns, times_ns[number : number + FEW]
        surely = len(after) == FEW or fall >= SURELY_SET_BACK_S * NS_PER_S
        if fall > 0 and surely and all(b - a < fall / 2 for a, b in pairwise(after)):
            offset, newest = offset + fall + usual, time_ns
        newest = max(newest, time_ns)
        found.append(time_ns + offset)
    return found


def passed_ns(stamps: Sequence[int], longest_s: float = LONGEST_GAP_S) -> list[int]:
    """Times from the first of some stamps in order: what is skipped is a usual step instead.

    Steps back are skipped, as of a clock that was set, and those that are longer.
    """
    # In ns: a sum of seconds misses a frame at 0.2 s by its last digit.
    steps = [b - a for a, b in pairwise(stamps)]
    usual, longest = _usual_step(steps), longest_s * NS_PER_S
    return list(accumulate((s if 0 <= s <= longest else usual for s in steps), initial=0))


def running_ns(stamps: Sequence[int]) -> list[int]:
    """Stamps in order that run on where a clock was set back."""
    return [stamps[0] + passed for passed in passed_ns(stamps, math.inf)] if stamps else []


def _usual_step(steps: Sequence[int]) -> int:
    usual = [step for step in steps if 0 < step <= LONGEST_GAP_S * NS_PER_S]
    return round(median(usual) if usual else NS_PER_S / DEFAULT_FRAME_RATE)


def _filled_stamps(messages: Sequence[StoredMessage], receipts: Sequence[int]) -> list[int]:
    """Stamps; for a message without one, its neighbour's and the time between their receipts."""
    stamped = [number for number, message in enumerate(messages) if message.stamp_ns]
    if not stamped:
        return [message.time_ns for message in messages]
    stamps = [message.stamp_ns for message in messages]
    for number, message in enumerate(messages):
        if message.stamp_ns:
            continue
        after = bisect_left(stamped, number)
        near = stamped[max(after - 1, 0)]
        stamps[number] = messages[near].stamp_ns + receipts[number] - receipts[near]
        if after < len(stamped):
            # Between its neighbours, whatever the receipts say.
            latest_ns = max(messages[near].stamp_ns, messages[stamped[after]].stamp_ns)
            stamps[number] = min(stamps[number], latest_ns)
    return stamps


def _between_restarts(stamps: Sequence[int], receipts: Sequence[int]) -> list[range]:
    """Parts in which the clock of the stamps runs on; it was set back between them.

    Where it was, stamps stay behind the receipts by as much.  A message that came late is alone
    behind, and belongs before those that came sooner.
    """
    delays = [receipt - stamp for receipt, stamp in zip(receipts, stamps, strict=True)]
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


def _gaps_text(
    stamps: Sequence[int], times: Sequence[int], messages: Sequence[StoredMessage]
) -> str:
    """One line on times that are skipped, or on receipts that are no guide to the time.

    times: of the stamps, which are in order, from the first frame, ns.
    """
    longest = LONGEST_GAP_S * NS_PER_S
    steps = [b - a for a, b in pairwise(stamps)]
    skipped = [number for number, step in enumerate(steps) if not 0 <= step <= longest]
    if skipped:
        at = max(skipped, key=lambda number: abs(steps[number]))
        place = f"the largest {steps[at] / NS_PER_S:.6g} s at {times[at + 1] / NS_PER_S:.2f} s"
        return f"skipped jumps of the stamps: {len(skipped)}, {place}"
    receipts = [message.time_ns for message in messages]
    gap = max((b - a for a, b in pairwise(receipts)), key=abs, default=0)
    if abs(gap) <= longest:
        return ""
    return f"skipped a gap of {gap / NS_PER_S:.6g} s between the times of receipt"
