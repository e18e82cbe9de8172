"""The component container in process: good components run whatever the bad ones do."""

import sys
import threading
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time
from rclpy.logging import LoggingSeverity, get_logger_effective_level
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock

from cmp_tactile_bringup.graphs.description import Component
from cmp_tactile_processing.errors import CmpTactileError

SAMPLES = Path(__file__).parents[1] / "sample_components"
TIMEOUT_S = 60.0


@pytest.fixture
def rig(make_box: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(SAMPLES))
    return make_box()


@pytest.mark.parametrize(
    ("plugin", "message"),
    [
        ("FailsHalfWay", r"x \(sample_components::FailsHalfWay\): ValueError: no gel on this"),
        ("Exits", "SystemExit: not here"),
        ("NoNode", "expected a class derived from rclpy's Node"),
        ("NoModule", "cannot be imported: ModuleNotFoundError"),
        ("Unknown", "no installed component 'sample_components::Unknown', expected one of: .*Echo"),
    ],
)
def test_failing_component_is_reported_and_leaves_no_node(rig, plugin, message):
    rig.load("Echo")
    with pytest.raises(CmpTactileError, match=message):
        rig.load(plugin, name="x")
    assert [item.full_name for item in rig.container.list().values()] == [f"{rig.namespace}/echo"]
    rig.wait(lambda: rig.names() == ["echo"], "the failed node to be gone")


def test_a_second_component_of_one_name_is_refused(rig):
    rig.load("Echo", name="twin")
    with pytest.raises(
        CmpTactileError, match=rf"found the name {rig.namespace}/twin, which id 1 has"
    ):
        rig.load("Ticker", name="twin")
    assert list(rig.container.list()) == [1]
    rig.wait(lambda: rig.names() == ["twin"], "the second node to be gone")
    rig.container.unload(1)
    assert rig.load("Ticker", name="twin") == 2


def test_wrong_names_are_one_line(rig):
    with pytest.raises(CmpTactileError, match=r"a b \(sample_components::Echo\): [^\n]*a b"):
        rig.load("Echo", name="a b")
    with pytest.raises(CmpTactileError, match="found package 'other'"):
        rig.container.load(Component("other", "sample_components::Echo"))


def test_busy_component_is_reported_and_goes_once_it_can(rig):
    sticks = rig.load("Sticks", parameters={"seconds": 1.0})
    assert sys.modules["sample_components"].Sticks.began.wait(TIMEOUT_S)
    with pytest.raises(
        CmpTactileError, match=r"sticks: found a callback that still runs after 0.05 s"
    ):
        rig.container.unload(sticks, timeout=0.05)
    assert rig.container.list() == {}
    rig.wait(lambda: rig.names() == [], "the node to be gone")


def test_shutdown_ends_everything(rig):
    waiting: list[str] = []

    def load_slow() -> None:
        try:
            rig.load("Slow", parameters={"seconds": 1.0})
        except CmpTactileError as error:
            waiting.append(str(error))

    for number in range(3):
        rig.load("Ticker", name=f"ticker_{number}")
    slow = threading.Thread(target=load_slow)
    slow.start()
    rig.wait(lambda: "slow" in rig.names(), "the slow constructor")
    rig.container.shutdown()
    slow.join()
    assert "the container is shutting down" in waiting[0]
    assert rig.container.list() == {}
    rig.wait(lambda: rig.names() == [], "all nodes to be gone")
    with pytest.raises(CmpTactileError, match="the container is shutting down"):
        rig.load("Echo")


def test_log_level(rig):
    rig.load("Echo", name="quiet", log_level=int(LoggingSeverity.ERROR))
    logger = f"{rig.namespace[1:]}.quiet"
    assert get_logger_effective_level(logger) is LoggingSeverity.ERROR
    with pytest.raises(CmpTactileError, match="log level: 7 is not a valid"):
        rig.load("Echo", log_level=7)


def test_components_share_what_they_hear_of_simulated_time(rig):
    """A subscription of each node made its executor build the wait set again for every message.

    Reports: ros2/rclpy 1378 and 792, ros/ros_comm 2342.
    """
    simulated = {"parameters": {"use_sim_time": True}}
    ids = [rig.load("Wired", name=f"wired_{number}", **simulated) for number in range(3)]
    real, gone, stays = (rig.container.list()[unique_id].node for unique_id in ids)
    publisher = rig.node.create_publisher(Clock, "/clock", 10)

    def seconds(node):
        return node.get_clock().now().nanoseconds / 1e9

    def send(number):
        publisher.publish(Clock(clock=Time(sec=number)))

    nodes = real, gone, stays
    rig.wait(lambda: send(5) or all(seconds(node) == 5 for node in nodes), "the time 5 s")
    assert publisher.get_subscription_count() == 1
    last_id = rig.load("Wired", name="late", **simulated)
    late = rig.container.list()[last_id].node
    assert seconds(late) == 5
    real.set_parameters([Parameter("use_sim_time", value=False)])
    assert seconds(real) > 1e9
    rig.container.unload(ids[1])
    rig.wait(lambda: send(6) or seconds(stays) == seconds(late) == 6, "the time 6 s")
    real.set_parameters([Parameter("use_sim_time", value=True)])
    assert seconds(real) == 6
    assert publisher.get_subscription_count() == 1
    rig.container.shutdown()
    rig.wait(lambda: publisher.get_subscription_count() == 0, "the container to be gone")
