"""What a node sends that has no input topic, such as a camera: rate, latency and drops, judged."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass, field

from cmp_tactile_processing.ros.diagnostics.hysteresis import FigureLevels, Finding
from cmp_tactile_processing.ros.diagnostics.latency_watch import LatencyWatch
from cmp_tactile_processing.ros.diagnostics.parameters import DiagnosticsParameters
from cmp_tactile_processing.ros.diagnostics.reporter import DIAGNOSTICS_PERIOD_S
from cmp_tactile_processing.ros.diagnostics.threshold_findings import (
    dropped_finding,
    late_finding,
    rate_finding,
)

__all__ = ["Period", "SentFrames"]

# A report between two others, as after a change of state, has too few frames to tell a rate.
SHORTEST_S = DIAGNOSTICS_PERIOD_S / 2


@dataclass(frozen=True)
class Period:
    """The figures of a period by name, and what the thresholds make of them."""

    values: dict[str, object] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()


class SentFrames:
    """Counts what is sent; the figures have the names that those of a stage have.

    `sent` may be called by another thread than the rest.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._latency = LatencyWatch()
        self._levels = FigureLevels()
        self._frames = self._late_before = self._dropped_before = 0
        self._since = time.monotonic()
        self._last: Period | None = None

    def sent(self, age_s: float = math.nan, late_after: float = math.inf) -> None:
        """A frame was sent, so long after its stamp; NaN: not known."""
        with self._lock:
            self._frames += 1
            self._latency.add(age_s, late_after)

    def close_period(
        self, limits: DiagnosticsParameters, dropped: int = 0, *, working: bool = True
    ) -> Period:
        """What was sent since the last call.

        dropped: frames since the start.  working: frames are to be sent; while they are not,
        nothing is found of their rate.
        """
        now = time.monotonic()
        with self._lock:
            if self._last is not None and now - self._since < SHORTEST_S:
                return self._last
            period, self._since = max(now - self._since, 1e-9), now
            frames, self._frames = self._frames, 0
            late, latencies = self._latency.late, self._latency.figures()
            self._latency.close_period()
        values = {
            "rate (Hz)": f"{frames / period:.2f}",
            **latencies,
            "late frames": late,
            "dropped frames": dropped,
        }
        found = {
            "rate": rate_finding(limits, frames / period),
            "late": late_finding(limits, late - self._late_before, frames),
            "dropped": dropped_finding(limits, max(0, dropped - self._dropped_before), frames),
        }
        self._late_before, self._dropped_before = late, dropped
        if not working:
            self._levels, found = FigureLevels(), {}
        self._last = Period(values, tuple(self._levels.renew(found, limits)))
        return self._last
