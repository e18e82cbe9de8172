"""Stamps of frames, one after the other: which are out of order, and what gaps between them say."""

from __future__ import annotations

from enum import Enum

__all__ = ["Stamp", "StampWatch"]

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
