"""Replays that begin together: none before all are ready, all at the same time."""

from functools import partial

import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from cmp_tactile_driver.nodes import replay as replay_node
from cmp_tactile_driver.nodes.replay import SETTLE_TIME, CommonStart, Replay
from cmp_tactile_processing.ros.base_nodes import latched_qos

NOW_NS = 1_800_000_000 * 10**9


class Clock:
    """The system's time, which stands still."""

    def __init__(self) -> None:
        self.ns = NOW_NS

    def time_ns(self) -> int:
        return self.ns


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(replay_node, "time", clock)
    return clock


def test_both_begin_a_moment_after_the_last_whenever_they_ask(ros, clock):
    ready = {"left": True, "right": False}
    starts = {
        name: CommonStart(
            ros.start(partial(Node, name)), partial(ready.get, name), f"{ros.namespace}/{other}"
        )
        for name, other in (("left", "right"), ("right", "left"))
    }
    assert starts["left"].remaining() is None
    assert starts["right"].remaining() is None
    clock.ns += 3 * 10**9
    assert starts["left"].remaining() is None
    ready["right"] = True
    ros.wait(lambda: starts["right"].remaining() is not None, "the word of the left one")
    ros.wait(lambda: starts["left"].remaining() is not None, "the word of the right one")
    clock.ns += 50_000_000
    left = starts["left"].remaining()
    clock.ns += 100_000_000
    right = starts["right"].remaining()
    # They asked 0.1 s apart: both mean the same time.
    assert left == pytest.approx(SETTLE_TIME - 0.05, abs=1e-9)
    assert right == pytest.approx(SETTLE_TIME - 0.15, abs=1e-9)
    clock.ns += 10**9
    assert starts["left"].remaining() == 0.0


def test_the_clock_of_another_machine_may_be_anywhere(ros, clock):
    start = CommonStart(ros.node, lambda: True, "/far/replay")
    publisher = ros.node.create_publisher(Header, "/far/replay/ready", latched_qos())
    publisher.publish(Header(stamp=Time(nanoseconds=NOW_NS + 10**12).to_msg()))
    ros.wait(lambda: start.remaining() is not None, "the word of the other")
    assert start.remaining() == SETTLE_TIME


def test_no_frame_is_sent_before_the_other_replay_is_there(ros, frame_bag, frames):
    images = ros.listen(Image, "image_raw")
    options = {"input": str(frame_bag), "wait_for_subscribers": 1, "rate": 10.0}
    ros.start(Replay, "left", begin_with=f"{ros.namespace}//right/", **options)
    ros.run(0.5)
    assert images == []
    ros.start(Replay, "right", begin_with=f"{ros.namespace}/left", **options)
    ros.wait(lambda: len(images) == 2 * len(frames), "the frames of both")


@pytest.mark.parametrize(
    ("options", "missing"),
    [
        ({"begin_with": "/nobody"}, "/nobody"),
        ({"wait_for_subscribers": 2}, "image_raw: found 1 subscribers, expected 2"),
    ],
)
def test_who_never_comes_is_not_waited_for_without_end_and_named(  # noqa: PLR0917  fixtures
    ros, frame_bag, frames, capfd, options, missing
):
    """As one line: the first frames will be missing, such as in a bag.

    Reports: ros2/rosbag2 1430 (the first messages are not in the bag, nobody says so),
    ros/ros_comm 959 (play waits for its subscribers); tried: waits, and names who did not come.
    """
    images = ros.listen(Image, "image_raw")
    ros.start(Replay, input=str(frame_bag), wait_timeout=2.0, rate=10.0, **options)
    ros.wait(lambda: len(images) == len(frames), "the frames")
    said = [line for line in capfd.readouterr().err.splitlines() if "within 2 s" in line]
    assert len(said) == 1
    assert missing in said[0]
