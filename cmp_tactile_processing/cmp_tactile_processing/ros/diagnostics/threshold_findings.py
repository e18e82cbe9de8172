"""What the thresholds of the diagnostics make of rates and counts; the same in every node."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticStatus

from cmp_tactile_processing.ros.diagnostics.hysteresis import Finding
from cmp_tactile_processing.ros.diagnostics.parameters import DiagnosticsParameters

__all__ = ["above", "dropped_finding", "finding", "late_finding", "rate_finding"]

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


def rate_finding(limits: DiagnosticsParameters, rate: float) -> Finding:
    """Of so many results a second."""
    level = ERROR if rate < limits.rate_error else WARN if rate < limits.rate_warn else OK
    return finding(level, f"{rate:.1f} results a second, expected {limits.rate_warn:g}")


def late_finding(limits: DiagnosticsParameters, late: int, frames: int) -> Finding:
    """Of late ones among all results of a period."""
    level = above(late / max(frames, 1), limits.late_warn, limits.late_error)
    return finding(level, f"{late} of {frames} results older than {limits.late_after * 1e3:g} ms")


def dropped_finding(limits: DiagnosticsParameters, dropped: int, frames: int) -> Finding:
    """Of frames that were dropped in a period, beside those that were not."""
    sent = frames + dropped
    level = above(dropped / max(sent, 1), limits.dropped_warn, limits.dropped_error)
    return finding(level, f"{dropped} of {sent} frames dropped")


def above(share: float, warn: float, error: float) -> bytes:
    """The level of a share that is to be small."""
    return ERROR if share > error else WARN if share > warn else OK


def finding(level: bytes, text: str) -> Finding:
    """With the text where there is something to be told."""
    return Finding(level, text if level > OK else "")
