"""What the parts of a node's diagnostics count and find, without a node."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy")

import math

from diagnostic_msgs.msg import DiagnosticStatus

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.ros.diagnostics import stage as stage_diagnostics
from cmp_tactile_processing.ros.diagnostics.frame_watch import InputWatch, LatencyWatch, Stamp
from cmp_tactile_processing.ros.diagnostics.stage import SentFrames, StageDiagnostics, age_in_days
from cmp_tactile_processing.ros.diagnostics.status import Finding, Hysteresis, summary
from cmp_tactile_processing.ros.diagnostics.thresholds import DiagnosticsParameters
from cmp_tactile_processing.ros.wiring import Input

pytestmark = pytest.mark.ros

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
MS = 1_000_000


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(stage_diagnostics.time, "monotonic", lambda: now[0])
    return now


def _info(number: int | None, publisher: bytes = b"a") -> dict:
    """As rclpy gives it."""
    gid = {"implementation_identifier": "x", "data": publisher}
    return {"publication_sequence_number": number, "publisher_gid": gid}


def test_numbers_of_messages_show_what_was_lost():
    """Of each publisher apart: one that starts, or starts again, is no loss."""
    watch = InputWatch()
    for number in (7, 8, 11):
        watch.take_message(1, _info(number))
    assert watch.lost == 2
    watch.take_message(1, _info(1, b"b"))
    watch.take_message(1, _info(12))
    watch.take_message(1, _info(2, b"b"))
    assert watch.lost == 2
    watch.take_message(1, _info(14))
    assert watch.lost == 3
    for number in (None, None):
        watch.take_message(1, _info(number))
    watch.take_message(1, None)
    assert watch.lost == 3


def test_losses_are_reported_where_rclpy_does_not_name_the_publisher():
    """As in ROS 2 Jazzy.  Two publishers by turns lose nothing, nor does one that starts again."""

    def lost(*numbers: int) -> int:
        watch = InputWatch()
        for number in numbers:
            info = _info(number)
            del info["publisher_gid"]
            watch.take_message(1, info)
        return watch.lost

    assert lost(7, 8, 11) == 2
    assert lost(100, 1, 101, 2, 102, 3) == 0
    assert lost(100, 101, 1, 2, 3, 5) == 1


def test_what_the_entrance_pushes_out_is_lost_or_passed_over():
    for newest in (False, True):
        watch = InputWatch(newest=newest)
        watch.end = Input(lambda _: lambda: None)
        watch.end.dropped = 2
        watch.take_message(1, _info(1, b"outside"))
        watch.take_message(1, _info(3, b"outside"))
        assert (watch.lost, watch.passed_over) == ((0, 3) if newest else (3, 0))


def test_stamps_out_of_order_are_distinguished():
    watch = InputWatch()
    kinds = [watch.take_message(stamp * MS, None) for stamp in (100, 150, 150, 0, 120, 170)]
    later, back, again, zero = Stamp.LATER, Stamp.BACK, Stamp.REPEATED, Stamp.ZERO
    assert kinds == [later, later, again, zero, back, later]
    assert watch.stamps == {later: 3, back: 1, again: 1, zero: 1}
    assert watch.missing == 0


def test_gaps_between_stamps_are_missing_frames_until_the_pace_is_another():
    watch = InputWatch()
    stamps = [33 * k for k in range(1, 20)]
    del stamps[12:15]
    for stamp in stamps:
        watch.take_message(stamp * MS, None)
    assert watch.missing == 3
    start = stamps[-1]
    for k in range(1, 40):
        watch.take_message((start + 100 * k) * MS, None)
    # A third of the rate: the first few look like gaps of two frames each.
    assert watch.missing == 3 + 5 * 2


def test_a_clock_that_is_set_and_another_recording_miss_no_frames():
    """Tried: 2591980 of 2592010 frames missing, where the second recording is of the next day.

    Reports: stereolabs/zed-ros-wrapper 778, ouster-lidar/ouster-sdk 176, evercam/ex_nvr 404.
    """
    watch = InputWatch()
    for day in range(3):
        for k in range(1, 10):
            watch.take_message((86_400_000 * day + 33 * k) * MS, None)
    assert watch.missing == 0
    # A source that was silent for two seconds.
    watch.take_message((86_400_000 * 2 + 33 * 69) * MS, None)
    assert watch.missing == 59


def test_frames_that_were_lost_here_are_not_missing_before_too():
    watch = InputWatch()
    for k in [*range(1, 10), 13, *range(14, 20), *range(22, 40, 3)]:
        watch.take_message(33 * k * MS, _info(k))
    assert watch.lost == 3 + 6 * 2
    assert watch.missing == 0
    # One more that nobody sent.
    watch.take_message(33 * 40 * MS, _info(40))
    assert watch.lost == 3 + 6 * 2 + 2
    watch.take_message(33 * 42 * MS, _info(41))
    assert watch.missing == 1


def test_latency_is_median_and_percentile_and_late_frames_count():
    watch = LatencyWatch()
    for k in range(101):
        watch.add(k * 1e-3, late_after=0.08)
    assert watch.figures() == {"latency median (ms)": "50.0", "latency p99 (ms)": "99.0"}
    assert watch.late == 20
    watch.close_period()
    assert watch.figures()["latency median (ms)"] == "no frames"
    watch.add(math.nan, 0.08)
    assert watch.figures()["latency median (ms)"] == "no frames"


@pytest.mark.parametrize("age_s", [3e7, -3.0, 11.0])
def test_latency_is_unknown_where_stamps_are_of_another_clock(age_s):
    watch = LatencyWatch()
    watch.add(age_s, 0.1)
    reported = watch.figures()["latency p99 (ms)"]
    assert reported.startswith(f"not known: stamps differ from the clock by {-age_s:+.0f} s")
    assert watch.late == 0


def test_a_figure_at_its_threshold_does_not_flicker():
    hysteresis = Hysteresis()
    ok, warn, error = Finding(OK, ""), Finding(WARN, "low"), Finding(ERROR, "none")

    def reported(*found: Finding) -> list[bytes]:
        return [hysteresis.renew(item, report_after=2, clear_after=3).level for item in found]

    assert reported(warn, ok, warn, ok) == [OK] * 4
    assert reported(warn, warn) == [OK, WARN]
    assert reported(ok, ok, warn, ok, ok) == [WARN] * 5
    assert reported(ok) == [OK]
    assert reported(error, warn) == [OK, WARN], "as bad as both"
    assert reported(error, error) == [WARN, ERROR]
    assert reported(ok, ok, ok) == [ERROR, ERROR, OK]


class _Report:
    """Level, message and values of a period."""

    def __init__(self, diagnostics: StageDiagnostics, clock: list[float], seconds: float = 1.0):
        clock[0] += seconds
        period = diagnostics.report()
        self.values = {key: str(value) for key, value in period.values.items()}
        self.level, self.message = summary(period.findings, "running")


def _second(diagnostics: StageDiagnostics, clock: list[float], **frames: int) -> _Report:
    """With so many frames in, out, lost, passed over and late."""
    diagnostics.inputs[0].add_lost(frames.get("lost", 0))
    diagnostics.passed_over += frames.get("passed_over", 0)
    for _ in range(frames.get("into", 30)):
        diagnostics.frame_in()
    for k in range(frames.get("out", 30)):
        diagnostics.frame_out(0.5 if k < frames.get("late", 0) else 0.01)
    return _Report(diagnostics, clock)


def _stage(**limits: float) -> StageDiagnostics:
    diagnostics = StageDiagnostics(DiagnosticsParameters(report_after=1, **limits))
    diagnostics.inputs.append(InputWatch())
    return diagnostics


@pytest.mark.parametrize(
    ("limits", "frames", "level", "text"),
    [
        ({"rate_warn": 31.0}, {}, WARN, "30.0 results a second, expected 31"),
        ({"rate_warn": 29.0}, {}, OK, "running"),
        ({"rate_warn": 40.0, "rate_error": 35.0}, {}, ERROR, "30.0 results a second, expected 40"),
        ({}, {"into": 0, "out": 0}, WARN, "no frames received"),
        ({"rate_warn": 1.0, "rate_error": 1.0}, {"into": 0, "out": 0}, ERROR, "no frames received"),
        ({}, {"late": 2}, WARN, "2 of 30 results older than 100 ms"),
        ({"late_after": 1.0}, {"late": 2}, OK, "running"),
        ({"late_error": 0.05}, {"late": 2}, ERROR, "2 of 30 results older than 100 ms"),
        ({}, {"lost": 3}, WARN, "3 of 33 frames dropped: 3 lost, 0 passed over"),
        ({}, {"lost": 31}, ERROR, "31 of 61 frames dropped: 31 lost, 0 passed over"),
        (
            {},
            {"passed_over": 30, "out": 0},
            WARN,
            "30 of 30 frames dropped: 0 lost, 30 passed over",
        ),
        ({"dropped_warn": 0.2}, {"lost": 3}, OK, "running"),
    ],
)
def test_each_threshold_has_its_say(clock, limits, frames, level, text):
    report = _second(_stage(**limits), clock, **frames)
    assert (report.level, report.message) == (level, text)


@pytest.mark.parametrize(("is_first", "level"), [(True, WARN), (False, OK)])
def test_frames_missing_before_are_reported_where_they_come_from_a_camera(clock, is_first, level):
    """Each later stage would repeat what the one before it reports."""
    diagnostics = _stage()
    diagnostics.is_first = is_first
    diagnostics.inputs[0].missing = 10
    report = _second(diagnostics, clock)
    assert report.level == level
    assert ("10 of 40 frames missing" in report.message) == is_first
    assert report.values["missing before"] == "10"


def test_rate_and_level_are_those_of_the_last_period(clock):
    diagnostics = StageDiagnostics()
    for _ in range(30):
        diagnostics.frame_in()
        diagnostics.frame_out(latency_s=0.0125)
    diagnostics.bad_frame("/rig/image_raw: step: found 3, expected 4")
    report = _Report(diagnostics, clock, 1.5)
    assert report.level == WARN
    assert "step: found 3, expected 4" in report.message
    assert report.values["rate (Hz)"] == "20.00"
    assert report.values["latency median (ms)"] == report.values["latency p99 (ms)"] == "12.5"
    assert (report.values["frames in"], report.values["bad frames"]) == ("30", "1")

    diagnostics.frame_in()
    diagnostics.frame_out()
    report = _Report(diagnostics, clock)
    assert report.level == OK
    assert report.values["rate (Hz)"] == "1.00"
    assert report.values["last error"] == "/rig/image_raw: step: found 3, expected 4"

    report = _Report(diagnostics, clock)
    assert (report.level, report.message) == (WARN, "no frames received")


def test_lasting_failure_is_an_error_whatever_comes_in(clock):
    diagnostics = StageDiagnostics()
    diagnostics.failure = "no model"
    diagnostics.frame_in()
    report = _Report(diagnostics, clock)
    assert (report.level, report.message) == (ERROR, "no model")


def test_age_of_the_calibration_is_reported_and_warned_of(clock, monkeypatch):
    assert age_in_days("2026-01-01T00:00:00Z", 1767225600.0 + 36 * 3600) == 1.5
    assert math.isnan(age_in_days(None))
    diagnostics = _stage()
    diagnostics.calibrations = {"calibration": "2020-01-01T00:00:00+00:00"}
    monkeypatch.setattr(
        stage_diagnostics, "age_in_days", lambda date: age_in_days(date, 1609459200.0)
    )
    report = _second(diagnostics, clock)
    assert report.message == "the calibration is 366 days old, expected at most 365"
    assert report.values["calibration age (days)"] == "366.0"
    diagnostics.calibrations = {"calibration": "2030-01-01T00:00:00Z"}
    assert "in the future" in _second(diagnostics, clock).message


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        (
            {"late_warn": 0.5, "late_error": 0.4},
            "diagnostics.late_warn: found 0.5, expected at most diagnostics.late_error, 0.4",
        ),
        ({"rate_error": 10.0}, "diagnostics.rate_error: found 10.0, expected at most .*rate_warn"),
        ({"tracked_warn": math.nan}, "diagnostics.tracked_warn: found nan"),
        ({"report_after": 0}, "diagnostics.report_after: found 0, expected at least 1"),
    ],
)
def test_thresholds_that_contradict_each_other_are_refused(values, reason):
    with pytest.raises(ParameterError, match=reason):
        DiagnosticsParameters(**values)


LIMITS = DiagnosticsParameters(report_after=1, clear_after=1, rate_warn=20.0, rate_error=5.0)


def test_a_report_between_two_others_has_no_rate_of_few_frames(clock):
    frames = SentFrames()
    for _ in range(30):
        frames.sent()
    clock[0] += 1.0
    before = frames.close_period(LIMITS)
    frames.sent()
    clock[0] += 0.1
    assert frames.close_period(LIMITS) == before
    clock[0] += 0.9
    assert frames.close_period(LIMITS).values["rate (Hz)"] == "1.00"
