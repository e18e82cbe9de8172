"""What the camera driver tells in /diagnostics."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticStatus

from cmp_tactile_driver.capture import Capture, CaptureState
from cmp_tactile_driver.frame_source import SourceHealth

__all__ = ["FrameRates", "Verdict", "judge"]


@dataclass(frozen=True)
class Verdict:
    """A level of diagnostic_msgs/DiagnosticStatus, and why."""

    level: bytes
    message: str


class FrameRates:
    """Rate and latency of the frames since they were last asked for.

    `sent` is called by the thread that publishes, the rest by another.
    """

    def __init__(self) -> None:
        self._began = time.monotonic()
        self._latencies_s: list[float] = []

    def sent(self, latency_s: float) -> None:
        """A frame was published so long after its stamp."""
        self._latencies_s.append(latency_s)

    def take(self) -> Mapping[str, object]:
        """The figures by name; begins anew."""
        latencies, self._latencies_s = self._latencies_s, []
        now = time.monotonic()
        elapsed, self._began = max(now - self._began, 1e-9), now
        figures: dict[str, object] = {"rate (Hz)": f"{len(latencies) / elapsed:.2f}"}
        if latencies:
            ordered = sorted(latencies)
            figures["latency, median (ms)"] = f"{ordered[len(ordered) // 2] * 1e3:.1f}"
            figures["latency, most (ms)"] = f"{ordered[-1] * 1e3:.1f}"
        return figures


def judge(problem: str, capture: Capture | None, health: SourceHealth, name: str) -> Verdict:
    """The state of the driver in one line.

    problem: why it could not be configured.  name: of what it reads.
    """
    if problem:
        return Verdict(DiagnosticStatus.ERROR, problem)
    if capture is None:
        return Verdict(DiagnosticStatus.WARN, "not configured")
    if capture.state is CaptureState.FAILED:
        return Verdict(DiagnosticStatus.ERROR, capture.failure)
    if capture.state is CaptureState.ENDED:
        return Verdict(DiagnosticStatus.WARN, f"{CaptureState.ENDED.value}: {name}")
    if health.problem:
        level = DiagnosticStatus.ERROR if health.silent else DiagnosticStatus.WARN
        return Verdict(level, health.problem)
    return Verdict(DiagnosticStatus.OK, capture.state.value)
