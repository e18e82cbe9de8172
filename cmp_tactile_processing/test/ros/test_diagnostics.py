"""What nodes report of bugs, stamps, ages and wrong connections."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy")

import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header

from cmp_tactile_msgs.msg import Surface
from cmp_tactile_processing.ros.base_nodes import StageNode

pytestmark = pytest.mark.ros


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
    ros.wait(lambda: node.diagnostics.frames_out == 1, "a result")
    assert _values(node._status())["latency median (ms)"] == "250.0"


def test_nobody_publishing_is_reported(ros):
    node = ros.start(_Relay)
    topic = f"{ros.namespace}/surface"
    assert node._status().message == f"no frames received: no publisher of {topic}"
    ros.node.create_publisher(Surface, "surface", 1)
    ros.wait(lambda: node._status().message == "no frames received", "the publisher")
