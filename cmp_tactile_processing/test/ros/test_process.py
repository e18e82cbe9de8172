"""What a process of ours makes of its command line for ROS."""

import pytest

pytest.importorskip("rclpy")

from cmp_tactile_processing.ros.process import Listener

pytestmark = pytest.mark.ros


class Silent(Listener):
    """Listens to nothing."""

    def _subscribe(self):
        pass


def test_a_listener_takes_the_arguments_of_ros_and_leaves_ours(monkeypatch, capfd):
    """rcl warned of `live slip view:=true`: "Found remap rule ... This syntax is deprecated"."""
    arguments = ["live", "view:=true", "--ros-args", "-r", "__node:=other", "--", "record:=bag"]
    monkeypatch.setattr("sys.argv", ["cmp_tactile", *arguments])
    with Silent("listener") as listener:
        assert listener.node.get_name() == "other"
    assert "deprecated" not in capfd.readouterr().err
