"""The state of the camera driver in one line, for /diagnostics."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticStatus

from cmp_tactile_driver.sources.capture import Capture, CaptureState
from cmp_tactile_driver.sources.frames import SourceHealth
from cmp_tactile_processing.ros.diagnostics.hysteresis import Finding

__all__ = ["judge"]


def judge(problem: str, capture: Capture | None, health: SourceHealth, name: str) -> Finding:
    """What is to be told; without text where nothing is.

    problem: why it could not be configured.  name: of what it reads.
    """
    if problem:
        return Finding(DiagnosticStatus.ERROR, problem)
    if capture is None:
        return Finding(DiagnosticStatus.WARN, "not configured")
    if capture.state is CaptureState.FAILED:
        return Finding(DiagnosticStatus.ERROR, capture.failure)
    if capture.state is CaptureState.ENDED:
        return Finding(DiagnosticStatus.WARN, f"{CaptureState.ENDED.value}: {name}")
    level = DiagnosticStatus.ERROR if health.silent else DiagnosticStatus.WARN
    return Finding(level if health.problem else DiagnosticStatus.OK, health.problem)
