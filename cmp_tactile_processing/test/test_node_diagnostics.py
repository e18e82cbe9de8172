"""Counting, judging and reporting of what a stage does."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from cmp_tactile_msgs.msg import Surface
from cmp_tactile_processing.nodes import stage_diagnostics
from cmp_tactile_processing.nodes.stage_diagnostics import StageDiagnostics
from cmp_tactile_processing.nodes.stage_node import StageNode

pytestmark = pytest.mark.ros


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(stage_diagnostics.time, "monotonic", lambda: now[0])
    return now


def _values(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def test_rate_and_level_are_those_of_the_last_period(clock):
    diagnostics = StageDiagnostics()
    for _ in range(30):
        diagnostics.frame_in()
        diagnostics.frame_out(latency_s=0.0125)
    diagnostics.bad_frame("/rig/image_raw: step: found 3, expected 4")
    clock[0] += 1.5
    status = diagnostics.status("rig/tracker", "rig")
    assert (status.name, status.hardware_id) == ("rig/tracker", "rig")
    assert status.level == DiagnosticStatus.WARN
    assert "step: found 3, expected 4" in status.message
    values = _values(status)
    assert values["rate (Hz)"] == "20.00"
    assert values["latency median (ms)"] == values["latency p99 (ms)"] == "12.5"
    assert (values["frames in"], values["bad frames"]) == ("30", "1")

    diagnostics.frame_in()
    diagnostics.frame_out()
    clock[0] += 1.0
    status = diagnostics.status("rig/tracker", "rig")
    assert status.level == DiagnosticStatus.OK
    assert _values(status)["rate (Hz)"] == "1.00"
    assert _values(status)["last error"] == "/rig/image_raw: step: found 3, expected 4"

    clock[0] += 1.0
    status = diagnostics.status("rig/tracker", "rig")
    assert (status.level, status.message) == (DiagnosticStatus.WARN, "no frames come in")


def test_lasting_failure_is_an_error_whatever_comes_in(clock):
    diagnostics = StageDiagnostics()
    diagnostics.failure = "no model"
    diagnostics.frame_in()
    status = diagnostics.status("rig/force", "rig")
    assert (status.level, status.message) == (DiagnosticStatus.ERROR, "no model")


class _Faulty(StageNode):
    """A node with a bug in it."""

    def __init__(self, **node_kwargs):
        super().__init__("faulty", **node_kwargs)

    def _set_up(self):
        self.add_input(Surface, "surface", self._divide)

    def _divide(self, msg):
        return 1 / msg.rows


def test_a_bug_in_a_callback_is_told_with_its_traceback_and_ends_nothing(ros, capfd):
    node = ros.start(_Faulty)
    reports = ros.listen(DiagnosticArray, "/diagnostics")
    publisher = ros.publisher(Surface, "surface")
    publisher.publish(Surface(rows=0))
    publisher.publish(Surface(rows=1))
    ros.wait(lambda: node.diagnostics.frames_in == 2, "both messages")
    name = f"{ros.namespace}/faulty"[1:]
    ros.wait(lambda: any(s.name == name for r in reports for s in r.status), "a report")
    (status,) = (s for r in reports[-1:] for s in r.status)
    assert status.level == DiagnosticStatus.WARN
    assert _values(status)["bad frames"] == "1"
    topic = f"{ros.namespace}/surface"
    assert _values(status)["last error"] == f"{topic}: ZeroDivisionError('division by zero')"
    log = capfd.readouterr().err
    assert "return 1 / msg.rows" in log
    assert topic in log
