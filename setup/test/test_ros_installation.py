"""A sourced ROS 2 is used; wheels, another checkout's too, are not taken for one."""

import pytest

from cmp_tactile_setup.machine import sourced_ros


@pytest.fixture
def prefix(tmp_path):
    path = tmp_path / "opt" / "ros" / "jazzy"
    (path / "share" / "rclpy").mkdir(parents=True)
    (path / "share" / "rclpy" / "package.xml").touch()
    return path


def test_a_sourced_installation(prefix, tmp_path):
    env = {"ROS_DISTRO": "jazzy", "AMENT_PREFIX_PATH": f"/overlay:{prefix}"}
    found = sourced_ros(env, tmp_path / "checkout")
    assert found is not None
    assert found.distro == "jazzy"
    assert found.prefix_of("rclpy") == prefix
    assert found.prefix_of("tf2_msgs") is None


def test_wheels_are_none(prefix, tmp_path):
    (prefix / "pyvenv.cfg").touch()
    env = {"ROS_DISTRO": "kilted", "AMENT_PREFIX_PATH": str(prefix)}
    assert sourced_ros(env, tmp_path / "checkout") is None


def test_what_lies_in_the_checkout_is_none(prefix, tmp_path):
    env = {"ROS_DISTRO": "kilted", "AMENT_PREFIX_PATH": str(prefix)}
    assert sourced_ros(env, tmp_path) is None
    assert sourced_ros(env, tmp_path / "elsewhere") is not None
