"""A sourced ROS 2 is used; wheels, another checkout's too, are not taken for one."""

import pytest

from cmp_tactile_setup.machine import sourced_ros
from cmp_tactile_setup.steps import SetupError


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


def test_no_ros_in_a_plain_shell(tmp_path):
    assert sourced_ros({}, tmp_path) is None


def test_a_name_without_an_installation_is_none(tmp_path):
    """A leftover ROS_DISTRO, or that of ROS 1, brings no rclpy."""
    env = {"ROS_DISTRO": "noetic", "AMENT_PREFIX_PATH": ""}
    assert sourced_ros(env, tmp_path) is None


def test_wheels_are_none(prefix, tmp_path):
    (prefix / "pyvenv.cfg").touch()
    env = {"ROS_DISTRO": "kilted", "AMENT_PREFIX_PATH": str(prefix)}
    assert sourced_ros(env, tmp_path / "checkout") is None


def test_what_lies_in_the_checkout_is_none(prefix, tmp_path):
    env = {"ROS_DISTRO": "kilted", "AMENT_PREFIX_PATH": str(prefix)}
    assert sourced_ros(env, tmp_path) is None
    assert sourced_ros(env, tmp_path / "elsewhere") is not None


@pytest.mark.parametrize("distro", ["foxy", "humble", "iron"])
def test_an_old_distribution_is_refused(prefix, tmp_path, distro):
    env = {"ROS_DISTRO": distro, "AMENT_PREFIX_PATH": str(prefix)}
    with pytest.raises(SetupError, match=f"'{distro}' is too old"):
        sourced_ros(env, tmp_path / "checkout")
