"""What a stage, or a source without an input, did since its start and in the last second."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timezone

from diagnostic_msgs.msg import DiagnosticStatus

from cmp_tactile_processing.ros.diagnostics import frame_watch
from cmp_tactile_processing.ros.diagnostics.status import (
    DIAGNOSTICS_PERIOD_S,
    FigureLevels,
    Finding,
    above,
    dropped_finding,
    finding,
    late_finding,
    rate_finding,
    status_message,
    summary,
)

SECONDS_PER_DAY = 86400.0


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
    return "no date recorded" if math.isnan(days) else f"{days:.1f}"


# A report between two others, as after a change of state, has too few frames for a rate.
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
        self._latency = frame_watch.LatencyWatch()
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
        self, limits: frame_watch.DiagnosticsParameters, dropped: int = 0, *, working: bool = True
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


OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
STAMP_FAULTS = {
    # A recording in a loop does so for good.
    frame_watch.Stamp.BACK: (OK, "went back, as where a recording begins again"),
    frame_watch.Stamp.REPEATED: (WARN, "came twice"),
    frame_watch.Stamp.ZERO: (WARN, "were 0"),
}


class StageDiagnostics:
    """Counts frames and remembers the last error; `status` closes one period.

    thresholds: may be replaced at any time.  inputs: what is known of each input topic.
    `failure` holds the text of a lasting failure, empty while the stage can work; `note` and
    `note_level` what the stage makes of its results; `extra` further figures of it by name;
    `calibrations` dates by name, None where none is recorded; `wrong_connections` what keeps
    others from being connected, `unpublished` input topics that nobody publishes.
    `is_first`: the frames come from a camera or a recording, which may not report what is missing.
    """

    def __init__(self, thresholds: frame_watch.DiagnosticsParameters | None = None) -> None:
        self.thresholds = thresholds or frame_watch.DiagnosticsParameters()
        self.inputs: list[frame_watch.InputWatch] = []
        self.latency = frame_watch.LatencyWatch()
        self.pattern = frame_watch.PatternWatch()
        self.frames_in = 0
        self.frames_out = 0
        self.bad_frames = 0
        self.passed_over = 0
        self.started_again = 0
        self.is_first = False
        self.last_error = ""
        self.failure = ""
        self.note = ""
        self.note_level: bytes = OK
        self.wrong_connections: list[str] = []
        self.unpublished: list[str] = []
        self.extra: dict[str, object] = {}
        self.calibrations: dict[str, str | None] = {}
        self._levels = FigureLevels()
        self._before = dict.fromkeys(self._counts(), 0)
        self._since = time.monotonic()

    @property
    def lost(self) -> int:
        """Messages that were sent to this node and never got to it."""
        return sum(item.lost for item in self.inputs)

    def frame_in(self) -> None:
        """A message came in."""
        self.frames_in += 1

    def frame_out(self, latency_s: float = math.nan) -> None:
        """A result was published, `latency_s` after the stamp of its camera frame."""
        self.frames_out += 1
        self.latency.add(latency_s, self.thresholds.late_after)

    def bad_frame(self, error: str) -> None:
        """A message could not be used."""
        self.bad_frames += 1
        self.last_error = error

    def status(self, name: str, hardware_id: str) -> DiagnosticStatus:
        """The state of the stage; rates are those since the last call."""
        now = time.monotonic()
        period = max(now - self._since, 1e-9)
        counts = self._counts()
        new = {key: count - self._before[key] for key, count in counts.items()}
        self._before, self._since = counts, now
        queues = [(item, item.waiting(new["frames in"] / period)) for item in self.inputs]
        ages = {key: age_in_days(date) for key, date in self.calibrations.items()}
        values = self._values(counts, new["frames out"] / period, queues, ages)
        summarised = summary(self._findings(new, period, queues, ages), self.note or "running")
        self.latency.close_period()
        return status_message(name, hardware_id, summarised, values)

    def _counts(self) -> dict[str, int]:
        stamps = {
            f"stamps {kind.value}": sum(item.stamps[kind] for item in self.inputs)
            for kind in STAMP_FAULTS
        }
        return {
            "frames in": self.frames_in,
            "frames out": self.frames_out,
            "bad frames": self.bad_frames,
            "lost on the way": self.lost,
            "passed over": self.passed_over + sum(item.passed_over for item in self.inputs),
            "late frames": self.latency.late,
            "missing before": sum(item.missing for item in self.inputs),
            **stamps,
        }

    def _values(
        self,
        counts: Mapping[str, int],
        rate: float,
        queues: list[tuple[frame_watch.InputWatch, float]],
        ages: Mapping[str, float],
    ) -> dict[str, object]:
        waiting = ", ".join(f"{queued:.0f} of {item.depth}" for item, queued in queues)
        values: dict[str, object] = {
            **counts,
            "dropped frames": counts["lost on the way"] + counts["passed over"],
            "rate (Hz)": f"{rate:.2f}",
            **self.latency.figures(),
            "queue": waiting or "none",
            "wrong connections": "; ".join(self.wrong_connections) or "none",
            "started again": self.started_again,
        }
        if not math.isnan(self.pattern.fraction):
            values["pattern lost"] = self.pattern.losses
            values["pattern found again"] = self.pattern.found
        values |= {f"{key} age (days)": age_text(days) for key, days in ages.items()}
        return values | {"last error": self.last_error} | self.extra

    def _findings(
        self,
        new: Mapping[str, int],
        period: float,
        queues: list[tuple[frame_watch.InputWatch, float]],
        ages: Mapping[str, float],
    ) -> Iterator[Finding]:
        if self.failure:
            yield Finding(ERROR, self.failure)
            return
        for text in self.wrong_connections:
            yield Finding(WARN, text)
        if not new["frames in"]:
            why = f": nobody publishes {', '.join(self.unpublished)}" if self.unpublished else ""
            level = ERROR if self.thresholds.rate_error else WARN
            yield Finding(level, f"no frames come in{why}")
            return
        if new["bad frames"]:
            yield Finding(WARN, f"{new['bad frames']} bad frames, last: {self.last_error}")
        yield Finding(self.note_level, self.note)
        for kind, (level, fault) in STAMP_FAULTS.items():
            count = new[f"stamps {kind.value}"]
            if count:
                yield Finding(level, f"stamps {fault} ({count} in the last second)")
        findings = self._threshold_findings(new, period, queues)
        findings |= {key: _calibration(self.thresholds, key, days) for key, days in ages.items()}
        yield from self._levels.renew(findings, self.thresholds)

    def _threshold_findings(
        self,
        new: Mapping[str, int],
        period: float,
        queues: list[tuple[frame_watch.InputWatch, float]],
    ) -> dict[str, Finding]:
        limits = self.thresholds
        return {
            "rate": rate_finding(limits, new["frames out"] / period),
            "late": late_finding(limits, new["late frames"], new["frames out"]),
            "dropped": _dropped(limits, new),
            # Those that another stage lost or passed over it reports itself.
            **({"missing": _missing(limits, new)} if self.is_first else {}),
            "tracked": _tracked(limits, self.pattern.fraction),
            "losses": _losses(limits, self.pattern.lost_lately()),
            **{f"queue {item.topic}": _queue(limits, item, queued) for item, queued in queues},
        }


def _dropped(limits: frame_watch.DiagnosticsParameters, new: Mapping[str, int]) -> Finding:
    lost, passed_over = new["lost on the way"], new["passed over"]
    sent = new["frames in"] + lost
    level = max(
        above(lost / sent, limits.dropped_warn, limits.dropped_error),
        # The node says itself why.
        above((lost + passed_over) / sent, limits.dropped_warn, 1.0),
    )
    text = f"{lost + passed_over} of {sent} frames dropped"
    return finding(level, f"{text}: {lost} lost on the way, {passed_over} passed over")


def _missing(limits: frame_watch.DiagnosticsParameters, new: Mapping[str, int]) -> Finding:
    missing = new["missing before"]
    sent = new["frames in"] + missing
    level = above(missing / sent, limits.missing_warn, 1.0)
    return finding(level, f"{missing} of {sent} frames missing: the source did not send them")


def _tracked(limits: frame_watch.DiagnosticsParameters, fraction: float) -> Finding:
    level = ERROR if fraction < limits.tracked_error else OK
    level = WARN if level == OK and fraction < limits.tracked_warn else level
    return finding(level, f"{fraction:.0%} of the pattern tracked")


def _losses(limits: frame_watch.DiagnosticsParameters, losses: int) -> Finding:
    level = WARN if 0 < limits.losses_warn <= losses else OK
    return finding(level, f"the pattern was lost {losses} times within a minute")


def _queue(
    limits: frame_watch.DiagnosticsParameters, item: frame_watch.InputWatch, queued: float
) -> Finding:
    level = above(queued / item.depth, limits.queue_warn, 1.0)
    return finding(level, f"{item.topic}: {queued:.0f} of {item.depth} messages wait")


def _calibration(limits: frame_watch.DiagnosticsParameters, key: str, days: float) -> Finding:
    if days < 0:
        return Finding(WARN, f"the date of the {key} is yet to come: the clock may be wrong")
    limit = limits.calibration_age_warn
    level = WARN if 0 < limit < days else OK
    return finding(level, f"the {key} is {days:.0f} days old, expected at most {limit:g}")
