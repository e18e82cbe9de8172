"""The set-up as a user runs it: what is wrong is said in one line, and nothing is left behind."""

import json
import os
import subprocess
import sys

import pytest


def bootstrap(root, **variables):
    env = {name: value for name, value in os.environ.items() if not name.startswith("ROS_")}
    for name in ("AMENT_PREFIX_PATH", "PYTHON", "CMP_TACTILE_ROS"):
        env.pop(name, None)
    env.update(variables)
    command = [sys.executable, str(root / "setup" / "bootstrap.py")]
    return subprocess.run(
        command, env=env, capture_output=True, text=True, timeout=600, check=False
    )


def assert_one_line(result, *words):
    assert result.returncode == 1
    lines = result.stderr.splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("set-up: ")
    for word in words:
        assert word in lines[0]


@pytest.mark.parametrize(
    "record", [".venv/cmp_tactile_wheels.json", "install/cmp_tactile_build.json"]
)
def test_a_moved_checkout(checkout, record):
    root = checkout("here")
    (root / record).parent.mkdir()
    (root / record).write_text(json.dumps({"root": "/there"}))
    assert_one_line(bootstrap(root), "set up at /there", str(root), "make clean")


def test_a_ros_distribution_that_is_too_old(checkout, tmp_path):
    prefix = tmp_path / "opt" / "ros" / "humble"
    (prefix / "share" / "rclpy").mkdir(parents=True)
    (prefix / "share" / "rclpy" / "package.xml").touch()
    result = bootstrap(checkout("here"), ROS_DISTRO="humble", AMENT_PREFIX_PATH=str(prefix))
    assert_one_line(result, "'humble' is too old", "Jazzy or newer")


def test_a_distribution_that_there_are_no_wheels_of(checkout):
    root = checkout("here")
    result = bootstrap(root, CMP_TACTILE_ROS="humble")
    assert_one_line(result, "CMP_TACTILE_ROS=humble", "kilted and jazzy")
    assert sorted(path.name for path in root.iterdir()) == ["setup"]


def test_wheels_asked_for_beside_another_ros(checkout, tmp_path):
    prefix = tmp_path / "opt" / "ros" / "kilted"
    (prefix / "share" / "rclpy").mkdir(parents=True)
    (prefix / "share" / "rclpy" / "package.xml").touch()
    sourced = {"ROS_DISTRO": "kilted", "AMENT_PREFIX_PATH": str(prefix)}
    result = bootstrap(checkout("here"), CMP_TACTILE_ROS="jazzy", **sourced)
    assert_one_line(result, "CMP_TACTILE_ROS=jazzy asks for jazzy", "sourced ROS 2 'kilted'")


def test_a_registry_that_cannot_be_reached(checkout, tmp_path):
    """With no way to any index, the last lines of pip's pages are shown."""
    root = checkout("here")
    for locked in (root / "setup").glob("locked-*.txt"):
        locked.write_text(f"cmp-tactile-no-such-library==0 --hash=sha256:{'0' * 64}\n")
    nowhere = {
        "PIP_CONFIG_FILE": os.devnull,
        "PIP_FIND_LINKS": "",
        "PIP_EXTRA_INDEX_URL": "",
        "PIP_INDEX_URL": "http://127.0.0.1:9/simple",
        "PIP_RETRIES": "1",
    }
    result = bootstrap(root, **nowhere)
    assert result.returncode == 1
    assert f"failed (log: {root / 'log' / 'pip.log'})" in result.stderr
    assert "cmp-tactile-no-such-library" in result.stderr
    assert len(result.stderr.splitlines()) <= 6
    assert not (root / ".venv" / "cmp_tactile_wheels.json").exists()
