"""Rate, latency and drops of a node that has no input topic, judged as those of a stage are."""

from __future__ import annotations

import threading

import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticStatus

from cmp_tactile_processing.ros.diagnostics import stage as stage_diagnostics
from cmp_tactile_processing.ros.diagnostics.parameters import DiagnosticsParameters
from cmp_tactile_processing.ros.diagnostics.stage import SentFrames

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
LIMITS = DiagnosticsParameters(told_after=1, told_until=1, rate_warn=20.0, rate_error=5.0)


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(stage_diagnostics.time, "monotonic", lambda: now[0])
    return now


def _second(frames: SentFrames, clock, count: int, late: int = 0, dropped: int = 0, **more: bool):
    for k in range(count):
        frames.sent(0.5 if k < late else 0.01, LIMITS.late_after)
    clock[0] += 1.0
    return frames.close_period(LIMITS, dropped, **more)


def _told(period) -> list[tuple[bytes, str]]:
    return [(item.level, item.text) for item in period.findings if item.text]


def test_figures_are_those_of_a_period(clock):
    frames = SentFrames()
    period = _second(frames, clock, 30)
    assert period.values["rate (Hz)"] == "30.00"
    assert period.values["latency median (ms)"] == period.values["latency p99 (ms)"] == "10.0"
    assert _told(period) == []
    period = _second(frames, clock, 10, late=5, dropped=30)
    assert period.values["rate (Hz)"] == "10.00"
    assert (period.values["late frames"], period.values["dropped frames"]) == (5, 30)
    assert _told(period) == [
        (WARN, "10.0 results a second, expected 20"),
        (WARN, "5 of 10 results older than 100 ms"),
        (ERROR, "30 of 40 frames dropped"),
    ]
    assert _told(_second(frames, clock, 30, dropped=30)) == [], "drops are those of the period"
    assert _told(_second(frames, clock, 0, dropped=30)) == [
        (ERROR, "0.0 results a second, expected 20")
    ]


def test_a_threshold_is_told_after_several_reports_in_a_row(clock):
    frames, limits = SentFrames(), DiagnosticsParameters(rate_warn=20.0, told_after=2)
    told = []
    for count in (10, 30, 10, 10):
        for _ in range(count):
            frames.sent()
        clock[0] += 1.0
        told.append(len(_told(frames.close_period(limits))))
    assert told == [0, 0, 0, 1]


def test_who_is_not_to_send_is_not_judged(clock):
    frames = SentFrames()
    assert _told(_second(frames, clock, 0, working=False)) == []
    assert _told(_second(frames, clock, 1)) != []


def test_a_report_between_two_others_does_not_tell_a_rate_of_few_frames(clock):
    frames = SentFrames()
    before = _second(frames, clock, 30)
    frames.sent()
    clock[0] += 0.1
    assert frames.close_period(LIMITS) == before
    clock[0] += 0.9
    assert frames.close_period(LIMITS).values["rate (Hz)"] == "1.00"


def test_frames_are_counted_while_another_thread_reports():
    frames, ended, counted = SentFrames(), threading.Event(), []

    def send():
        for _ in range(20_000):
            frames.sent(0.01, 0.1)
        ended.set()

    thread = threading.Thread(target=send)
    thread.start()
    while not ended.is_set():
        counted.append(frames.close_period(LIMITS))
    thread.join()
    assert counted
