"""What a stage, or a source without an input, did since its start and in the last second."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone

from cmp_tactile_processing.ros.diagnostics import frame_watch
from cmp_tactile_processing.ros.diagnostics.status import (
    DIAGNOSTICS_PERIOD_S,
    ERROR,
    OK,
    WARN,
    FigureLevels,
    Finding,
    above,
    below,
    finding,
)
from cmp_tactile_processing.ros.diagnostics.thresholds import DiagnosticsParameters

SECONDS_PER_DAY = 86400.0
# A report between two others, as after a change of state, has too few frames for a rate.
SHORTEST_S = DIAGNOSTICS_PERIOD_S / 2


@dataclass(frozen=True)
class Period:
    """The figures of a period by name, and what the thresholds make of them."""

    values: dict[str, object] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()


class SentFrames:
    """Counts what is sent; the figures have the same names in every node.

    `sent` may be called by another thread than the rest.
    """

    def __init__(self) -> None:
        self.frames = 0
        self._lock = threading.Lock()
        self._latency = frame_watch.LatencyWatch()
        self._levels = FigureLevels()
        self._before = (0, 0, 0, 0)
        self._since = time.monotonic()
        self._last: Period | None = None

    def sent(self, age_s: float = math.nan, late_after: float = math.inf) -> None:
        """A frame was sent, so long after its stamp; NaN: not known."""
        with self._lock:
            self.frames += 1
            self._latency.add(age_s, late_after)

    def close_period(
        self,
        limits: DiagnosticsParameters,
        dropped: int = 0,
        passed_over: int = 0,
        *,
        working: bool = True,
    ) -> Period:
        """What was sent since the last call.

        dropped: frames since the start.  passed_over: further ones, that were let be on purpose.
        working: frames are to be sent; while they are not, nothing is found of their rate.
        """
        now = time.monotonic()
        with self._lock:
            if self._last is not None and now - self._since < SHORTEST_S:
                return self._last
            counts = self.frames, self._latency.late, dropped, passed_over
            latencies = self._latency.figures()
            self._latency.close_period()
        rate = (counts[0] - self._before[0]) / max(now - self._since, 1e-9)
        values = {
            "rate (Hz)": f"{rate:.2f}",
            **latencies,
            "late frames": counts[1],
            "dropped frames": dropped + passed_over,
        }
        new = [max(0, a - b) for a, b in zip(counts, self._before, strict=True)]
        found = _findings(limits, rate, new)
        self._before, self._since = counts, now
        if not working:
            self._levels, found = FigureLevels(), {}
        self._last = Period(values, tuple(self._levels.renew(found, limits)))
        return self._last


def _findings(limits: DiagnosticsParameters, rate: float, new: Sequence[int]) -> dict[str, Finding]:
    """By the name of the figure; new: frames, late, lost, and passed over in a period."""
    frames, late, lost, passed_over = new
    dropped = lost + passed_over
    wanted = max(frames + dropped, 1)
    # Of what was passed over the node says itself why.
    level = max(
        above(lost / wanted, limits.dropped_warn, limits.dropped_error),
        above(dropped / wanted, limits.dropped_warn),
    )
    slow = below(rate, limits.rate_warn, limits.rate_error)
    old = above(late / max(frames, 1), limits.late_warn, limits.late_error)
    ms = limits.late_after * 1e3
    return {
        "rate": finding(slow, f"{rate:.1f} results a second, expected {limits.rate_warn:g}"),
        "late": finding(old, f"{late} of {frames} results older than {ms:g} ms"),
        "dropped": finding(
            level,
            f"{dropped} of {wanted} frames dropped: {lost} lost, {passed_over} passed over",
        ),
    }


STAMP_FAULTS = {
    # A recording in a loop does so for good.
    frame_watch.Stamp.BACK: (OK, "went back, for example at the start of a repeated recording"),
    frame_watch.Stamp.REPEATED: (WARN, "came twice"),
    frame_watch.Stamp.ZERO: (WARN, "were 0"),
}


class StageDiagnostics:
    """Counts frames and remembers the last error; `report` closes one period.

    thresholds: may be replaced at any time.  inputs: what is known of each input topic.
    `failure` holds the text of a lasting failure, empty while the stage can work; `note` and
    `note_level` what the stage makes of its results; `extra` further figures of it by name;
    `tracked` the share of the pattern that the last frame shows, NaN where that is not asked;
    `calibrations` dates by name, None where none is recorded; `unpublished` input topics that
    nobody publishes.
    `is_first`: the frames come from a camera or a recording, which may not report what is missing.
    """

    def __init__(self, thresholds: DiagnosticsParameters | None = None) -> None:
        self.thresholds = thresholds or DiagnosticsParameters()
        self.inputs: list[frame_watch.InputWatch] = []
        self.frames_in = 0
        self.bad_frames = 0
        self.passed_over = 0
        self.started_again = 0
        self.tracked = math.nan
        self.is_first = False
        self.last_error = ""
        self.failure = ""
        self.note = ""
        self.note_level: bytes = OK
        self.unpublished: list[str] = []
        self.extra: dict[str, object] = {}
        self.calibrations: dict[str, str | None] = {}
        self._sent = SentFrames()
        self._levels = FigureLevels()
        self._before = dict.fromkeys(self._counts(), 0)

    @property
    def lost(self) -> int:
        """Messages that were sent to this node and never got to it."""
        return sum(item.lost for item in self.inputs)

    @property
    def frames_out(self) -> int:
        """Results that were published."""
        return self._sent.frames

    def frame_in(self) -> None:
        """A message came in."""
        self.frames_in += 1

    def frame_out(self, latency_s: float = math.nan) -> None:
        """A result was published, `latency_s` after the stamp of its camera frame."""
        self._sent.sent(latency_s, self.thresholds.late_after)

    def bad_frame(self, error: str) -> None:
        """A message could not be used."""
        self.bad_frames += 1
        self.last_error = error

    def report(self) -> Period:
        """The state of the stage; the worst comes first."""
        counts = self._counts()
        new = {key: count - self._before[key] for key, count in counts.items()}
        self._before = counts
        sent = self._sent.close_period(self.thresholds, self.lost, counts["passed over"])
        ages = {key: age_in_days(date) for key, date in self.calibrations.items()}
        values = {
            **counts,
            **sent.values,
            "started again": self.started_again,
            **{f"{key} age (days)": age_text(days) for key, days in ages.items()},
            "last error": self.last_error,
            **self.extra,
        }
        return Period(values, tuple(self._findings(new, sent, ages)))

    def _counts(self) -> dict[str, int]:
        return {
            "frames in": self.frames_in,
            "frames out": self.frames_out,
            "bad frames": self.bad_frames,
            "lost on the way": self.lost,
            "passed over": self.passed_over + sum(item.passed_over for item in self.inputs),
            "missing before": sum(item.missing for item in self.inputs),
            **{
                f"stamps {kind.value}": sum(item.stamps[kind] for item in self.inputs)
                for kind in STAMP_FAULTS
            },
        }

    def _findings(
        self, new: Mapping[str, int], sent: Period, ages: Mapping[str, float]
    ) -> Iterator[Finding]:
        if self.failure:
            yield Finding(ERROR, self.failure)
            return
        if not new["frames in"]:
            why = f": no publisher of {', '.join(self.unpublished)}" if self.unpublished else ""
            level = ERROR if self.thresholds.rate_error else WARN
            yield Finding(level, f"no frames received{why}")
            return
        if new["bad frames"]:
            yield Finding(WARN, f"{new['bad frames']} bad frames, last: {self.last_error}")
        yield Finding(self.note_level, self.note)
        for kind, (level, fault) in STAMP_FAULTS.items():
            if count := new[f"stamps {kind.value}"]:
                yield Finding(level, f"stamps {fault} ({count} in the last second)")
        yield from sent.findings
        yield from self._levels.renew(self._own_findings(new, ages), self.thresholds)

    def _own_findings(
        self, new: Mapping[str, int], ages: Mapping[str, float]
    ) -> dict[str, Finding]:
        limits = self.thresholds
        missing, tracked = new["missing before"], self.tracked
        level = below(tracked, limits.tracked_warn, limits.tracked_error)
        found = {"tracked": finding(level, f"only {tracked:.0%} of the pattern is tracked")}
        # Those that another stage lost or passed over it reports itself.
        if self.is_first:
            wanted = new["frames in"] + missing
            text = f"{missing} of {wanted} frames missing: the source did not send them"
            found["missing"] = finding(above(missing / wanted, limits.missing_warn), text)
        return found | {key: _calibration(limits, key, days) for key, days in ages.items()}


def age_in_days(date: str | None, now_s: float | None = None) -> float:
    """Days since a date as calibration writes it, ISO 8601 in UTC; NaN without one.

    now_s: since the epoch, else the system's clock: a recording's calibration ages, too.
    """
    if not date:
        return math.nan
    # Python 3.10 does not read the Z.
    made = datetime.fromisoformat(date[:-1] + "+00:00" if date.endswith("Z") else date)
    now = time.time() if now_s is None else now_s
    return (now - made.astimezone(timezone.utc).timestamp()) / SECONDS_PER_DAY


def age_text(days: float) -> str:
    """The age as a figure of the diagnostics."""
    return "no date" if math.isnan(days) else f"{days:.1f}"


def _calibration(limits: DiagnosticsParameters, key: str, days: float) -> Finding:
    if days < 0:
        return Finding(WARN, f"the date of the {key} is in the future: check the clock")
    limit = limits.calibration_age_warn
    level = WARN if 0 < limit < days else OK
    return finding(level, f"the {key} is {days:.0f} days old, expected at most {limit:g}")
