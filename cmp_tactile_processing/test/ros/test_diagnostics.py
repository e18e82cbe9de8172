"""What nodes report of bugs, stamps, ages and wrong connections, and what counts these."""

from __future__ import annotations

import math

import pytest

pytest.importorskip("rclpy")

import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header

from cmp_tactile_msgs.msg import Surface
from cmp_tactile_processing.errors import Finding, Severity
from cmp_tactile_processing.ros import diagnostics
from cmp_tactile_processing.ros.base_nodes import StageNode
from cmp_tactile_processing.ros.diagnostics import (
    SILENT_S,
    InputWatch,
    SentFrames,
    StageDiagnostics,
    StampWatch,
    summary,
)
from cmp_tactile_processing.ros.wiring import Input

pytestmark = pytest.mark.ros

OK, WARN, ERROR = Severity.OK, Severity.WARNING, Severity.ERROR
MS = 1_000_000


def _values(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


class _Faulty(StageNode):
    """A node with a bug in it."""

    default_name = "faulty"

    def _set_up(self):
        self.add_input(Surface, "surface", self._divide, lambda msg: msg)

    def _divide(self, msg, _header):
        return 1 / msg.rows


def test_a_bug_in_a_callback_is_reported_with_its_traceback_and_ends_nothing(ros, capfd):
    node = ros.start(_Faulty)
    reports = ros.reports("faulty")
    publisher = ros.publisher(Surface, "surface")
    publisher.publish(Surface(rows=0))
    publisher.publish(Surface(rows=1))
    ros.wait(lambda: reports.values.get("bad frames") == "1", "a report")
    assert reports.last.level == DiagnosticStatus.WARN
    topic = f"{ros.namespace}/surface"
    assert reports.values["last error"] == f"{topic}: ZeroDivisionError('division by zero')"
    ros.wait(lambda: node.diagnostics.frames_in == 2, "the second message")
    log = capfd.readouterr().err
    assert "return 1 / msg.rows" in log
    assert topic in log


class _Relay(StageNode):
    """A stage that passes surfaces on."""

    default_name = "relay"

    def _set_up(self):
        self.results = self.add_publisher(Surface, "result")
        self.add_input(Surface, "surface", self._work, lambda msg: msg)

    def _work(self, msg, _header):
        self.results.publish(msg)
        self.frame_out(msg.header)

    def _start_again(self, topic):
        self.diagnostics.extra["started again on"] = topic


def _surface(stamp_ns: int) -> Surface:
    stamp = Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return Surface(header=Header(stamp=stamp))


def test_a_recording_that_begins_again_goes_on_and_is_reported(ros):
    node = ros.start(_Relay)
    results = ros.listen(Surface, "result")
    ros.wait_subscribed(node, "result")
    publisher = ros.publisher(Surface, "surface")
    stamps = [100, 200, 300, 300, 0, 100, 200]
    for stamp in stamps:
        publisher.publish(_surface(stamp * 10**6))
    ros.wait(lambda: len(results) == len(stamps), "a result of every frame")
    status = node._status()
    values = _values(status)
    assert (values["stamps back"], values["started again"]) == ("1", "1")
    assert values["started again on"] == "surface"
    assert (values["stamps repeated"], values["stamps zero"]) == ("1", "1")
    assert status.level == DiagnosticStatus.WARN
    assert "stamps came twice (1 in the last second)" in status.message
    # Stamps of seconds after 1970: no latency can be reported.
    assert values["latency median (ms)"].startswith("not known: stamps differ from the clock by -")


@pytest.fixture
def outside(ros):
    """A node of another process, as far as the middleware knows."""
    context = rclpy.Context()
    context.init()
    node = rclpy.create_node("outside", context=context, namespace=ros.namespace)
    yield node
    node.destroy_node()
    context.try_shutdown()


def test_ends_that_cannot_be_connected_are_logged(ros, outside, capfd):
    ros.start(_Relay)
    unreliable = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    outside.create_publisher(Surface, "surface", unreliable)
    outside.create_subscription(Surface, "result", lambda _: None, latched)
    log = []

    def both() -> bool:
        log.append(capfd.readouterr().err)
        text = "".join(log)
        return "surface" in text and "RELIABILITY" in text and "DURABILITY" in text

    ros.wait(both, "a warning of each")


def test_a_clock_that_stands_still_silences_nobody(ros):
    """As in a simulation that is paused: ros/diagnostics 210, 458 (stale, or of another clock)."""
    ros.start(_Relay, use_sim_time=True)
    reports = ros.listen(DiagnosticArray, "/diagnostics")
    name = f"{ros.namespace}/relay"[1:]
    ros.wait(lambda: [r for r in reports if r.status[0].name == name], "a report")
    (report,) = [r for r in reports if r.status[0].name == name][:1]
    assert report.header.stamp == Time()


def test_age_is_counted_by_the_clock_of_a_recording(ros):
    """As `ros2 bag play --clock` gives it: a frame is as old as it was when it was recorded."""
    node = ros.start(_Relay, use_sim_time=True)
    ros.publisher(Clock, "/clock").publish(Clock(clock=Time(sec=100)))
    ros.wait(lambda: node.get_clock().now().nanoseconds == 100 * 10**9, "the clock")
    ros.publisher(Surface, "surface").publish(_surface(99_750 * 10**6))
    ros.wait(lambda: node.diagnostics.sent.frames == 1, "a result")
    assert _values(node._status())["latency median (ms)"] == "250.0"


def test_nobody_publishing_is_reported(ros):
    node = ros.start(_Relay)
    topic = f"{ros.namespace}/surface"
    assert node._status().message == f"no frames received: no publisher of {topic}"
    ros.node.create_publisher(Surface, "surface", 1)
    ros.wait(lambda: node._status().message == "no frames received", "the publisher")


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(diagnostics.time, "monotonic", lambda: now[0])
    return now


def _end() -> Input:
    return Input(lambda _: lambda: None)


@pytest.mark.parametrize(
    ("infos", "lost"),
    [
        ([(7, b"a"), (8, b"a"), (11, b"a")], 2),
        ([(7, b"a"), (1, b"b"), (8, b"a"), (2, b"b"), (None, b"a"), (10, b"a")], 1),
        # ROS 2 Jazzy does not name the publisher: two by turns lose nothing, nor does a restart.
        ([(7,), (8,), (11,)], 2),
        ([(100,), (1,), (101,), (2,), (102,), (3,)], 0),
        ([(100,), (101,), (1,), (2,), (3,), (5,)], 1),
    ],
)
def test_numbers_of_messages_show_what_was_lost(infos, lost):
    """Of each publisher apart: one that starts, or starts again, is no loss."""
    watch = InputWatch(_end())
    watch.take(None)
    for number, *publisher in infos:
        gid = {"publisher_gid": {"data": publisher[0]}} if publisher else {}
        watch.take({"publication_sequence_number": number, **gid})
    assert watch.lost == lost


def test_gaps_between_stamps_are_missing_frames_until_the_pace_is_another():
    watch = StampWatch()
    stamps = [33 * k for k in range(1, 20)]
    del stamps[12:15]
    for stamp in stamps:
        watch.take(stamp * MS)
    assert watch.missing == 3
    start = stamps[-1]
    for k in range(1, 40):
        watch.take((start + 100 * k) * MS)
    # A third of the rate: the first few look like gaps of two frames each.
    assert watch.missing == 3 + 5 * 2


def test_gaps_before_and_after_a_recording_begins_again_are_no_new_pace():
    watch = StampWatch()
    for steps in ([33] * 10 + [99] * 4, [99] * 4 + [33] * 3):
        stamp = 1000
        for step in steps:
            stamp += step
            watch.take(stamp * MS)
    # The first stamp of the second pass is before the last one of the first: it ends no gap.
    assert watch.missing == (4 + 3) * 2


def test_the_worst_finding_comes_first():
    findings = [Finding(WARN, "warm"), Finding(OK, ""), Finding(ERROR, "hot"), Finding(OK, "fine")]
    assert summary(findings, "running") == Finding(ERROR, "hot; warm; fine")


def test_a_clock_that_is_set_and_another_recording_miss_no_frames():
    """Tried: 2591980 of 2592010 frames missing, where the second recording is of the next day.

    Reports: stereolabs/zed-ros-wrapper 778, ouster-lidar/ouster-sdk 176, evercam/ex_nvr 404.
    """
    watch = StampWatch()
    for day in range(3):
        for k in range(1, 10):
            watch.take((86_400_000 * day + 33 * k) * MS)
    assert watch.missing == 0
    # A source that was silent for two seconds.
    watch.take((86_400_000 * 2 + 33 * 69) * MS)
    assert watch.missing == 59


def test_rate_and_latency_are_those_of_the_last_period(clock):
    """A report between two others, as after a change of state, has too few frames for a rate."""
    frames = SentFrames()
    for k in range(101):
        frames.sent(k * 1e-3)
    clock[0] += 2.0
    before = frames.close_period()
    assert before == {
        "rate (Hz)": "50.50", "latency median (ms)": "50.0", "latency p99 (ms)": "99.0"
    }  # fmt: skip
    frames.sent(math.nan)
    clock[0] += 0.1
    assert frames.close_period() == before
    clock[0] += 0.9
    assert frames.close_period()["rate (Hz)"] == "1.00"
    assert frames.close_period()["latency median (ms)"] == "no frames"


@pytest.mark.parametrize("age_s", [3e7, -3.0, 11.0])
def test_latency_is_unknown_where_stamps_are_of_another_clock(age_s):
    frames = SentFrames()
    frames.sent(age_s)
    reported = frames.close_period()["latency p99 (ms)"]
    assert reported.startswith(f"not known: stamps differ from the clock by {-age_s:+.0f} s")


def _reported(diagnostics: StageDiagnostics) -> Finding:
    _, findings = diagnostics.report()
    return summary(findings, "running")


def test_losses_are_warned_of_and_a_newer_frame_in_the_place_of_another_is_no_loss():
    for newest, words in ((False, (3, 0)), (True, (0, 3))):
        diagnostics, end = StageDiagnostics(), _end()
        diagnostics.inputs.append(InputWatch(end, newest=newest))
        diagnostics.frames_in, end.dropped = 30, 3
        text = "{} frames lost on the way, {} passed over, 30 received".format(*words)
        assert _reported(diagnostics) == Finding(WARN, text)
        diagnostics.frames_in += 30
        assert _reported(diagnostics) == Finding(OK, "running")


@pytest.mark.parametrize(("received", "level"), [(98, WARN), (99, OK)])
def test_one_frame_in_a_hundred_that_were_sent_may_be_lost(received, level):
    diagnostics, end = StageDiagnostics(), _end()
    diagnostics.inputs.append(InputWatch(end))
    diagnostics.frames_in, end.dropped = received, 1
    assert _reported(diagnostics).severity == level


@pytest.mark.parametrize("report_s", [0.1, 1.0])
@pytest.mark.parametrize("pause_s", [1, 2, 4, 10])
def test_a_slow_source_is_not_a_silent_one(clock, pause_s, report_s):
    """As in ros/diagnostics 45: a topic of 0.3 Hz has no message in most seconds."""
    diagnostics = StageDiagnostics()

    def levels_for(seconds: float) -> list[bytes]:
        levels = []
        for _ in range(round(seconds / report_s)):
            clock[0] += report_s
            levels.append(_reported(diagnostics).severity)
        return levels

    # The first pause is not known to be usual yet.
    for _ in range(3):
        diagnostics.frames_in += 1
        levels = levels_for(pause_s)
    assert set(levels) == {OK}
    assert levels_for(SILENT_S + pause_s)[-1] == WARN


def test_bad_frames_are_warned_of_in_their_second_and_the_last_one_is_remembered(clock):
    diagnostics = StageDiagnostics()
    diagnostics.frames_in = 30
    diagnostics.bad_frame("/rig/image_raw: step: found 3, expected 4")
    text = "1 bad frames, last: /rig/image_raw: step: found 3, expected 4"
    assert _reported(diagnostics) == Finding(WARN, text)
    diagnostics.frames_in += 1
    values, findings = diagnostics.report()
    assert summary(findings, "running") == Finding(OK, "running")
    assert values["last error"] == "/rig/image_raw: step: found 3, expected 4"
    clock[0] += SILENT_S - 0.1
    assert _reported(diagnostics).severity == OK
    clock[0] += 0.2
    assert _reported(diagnostics) == Finding(WARN, "no frames received")


def test_lasting_failure_is_an_error_whatever_comes_in():
    diagnostics = StageDiagnostics()
    diagnostics.failure = "no model"
    diagnostics.frames_in += 1
    assert _reported(diagnostics) == Finding(ERROR, "no model")
