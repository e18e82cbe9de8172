"""The environment that users get, from each shell, and what it does not inherit."""

import shutil
import subprocess

import pytest

from cmp_tactile_setup.layout import (
    Layout,
    build_environment,
    clean_environment,
    write_environment_file,
)
from cmp_tactile_setup.machine import RosInstallation


@pytest.fixture
def ready(layout, checkout):
    """A checkout that looks set up: the scripts, and an install folder with a setup file."""
    scripts = checkout("scripts") / "setup"
    for name in ("env.sh", "run"):
        shutil.copy(scripts / name, layout.root / "setup")
    layout.install.mkdir()
    (layout.install / "setup.sh").write_text(
        f"export AMENT_PREFIX_PATH={layout.install}/a:$AMENT_PREFIX_PATH\n"
        f"export PYTHONPATH={layout.install}/a/python\n"
        f"export LD_LIBRARY_PATH={layout.install}/a/lib:$LD_LIBRARY_PATH\n"
    )
    clean = {"PATH": "/usr/bin:/bin"}
    env = build_environment(layout, clean)
    write_environment_file(layout, env)
    return layout


def shell(shell_name, script, cwd, **env):
    executable = shutil.which(shell_name)
    if executable is None:
        pytest.skip(f"{shell_name} is not installed")
    env = {"PATH": "/usr/bin:/bin", **env}
    return subprocess.run(
        [executable, "-c", script], cwd=cwd, env=env, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("name", ["bash", "zsh"])
def test_sourced_from_anywhere(ready, tmp_path, name):
    script = f". {ready.root}/setup/env.sh && echo $AMENT_PREFIX_PATH"
    result = shell(name, script, tmp_path)
    assert result.stdout == f"{ready.install}/a:{ready.venv}\n", result.stderr


def test_sourced_in_the_checkout_by_a_shell_that_knows_no_more(ready):
    result = shell("sh", ". ./setup/env.sh && echo $PYTHONPATH", ready.root)
    assert result.stdout == f"{ready.install}/a/python\n", result.stderr


def test_sourcing_twice_adds_nothing(ready):
    once = shell("bash", ". setup/env.sh && env | sort", ready.root, LD_LIBRARY_PATH="/own")
    twice = shell(
        "bash", ". setup/env.sh && . setup/env.sh && env | sort", ready.root, LD_LIBRARY_PATH="/own"
    )
    assert twice.stdout == once.stdout
    assert ":/own\n" in once.stdout


def test_the_commands_of_the_suite_come_first_in_path(ready):
    result = shell("bash", ". setup/env.sh && echo $PATH", ready.root)
    assert result.stdout == f"{ready.install}/bin:{ready.venv}/bin:/usr/bin:/bin\n"


def test_the_graph_stays_on_this_machine_unless_asked_otherwise(ready):
    script = ". setup/env.sh && echo $ROS_AUTOMATIC_DISCOVERY_RANGE"
    assert shell("bash", script, ready.root).stdout == "LOCALHOST\n"
    wide = shell("bash", script, ready.root, ROS_AUTOMATIC_DISCOVERY_RANGE="SUBNET")
    assert wide.stdout == "SUBNET\n"


def test_ros_chooses_among_environments_that_lie_side_by_side(ready):
    jazzy = Layout(ready.root, "jazzy")
    jazzy.install.mkdir()
    (jazzy.install / "setup.sh").write_text(f"export PYTHONPATH={jazzy.install}/a/python\n")
    env = build_environment(jazzy, {"PATH": "/usr/bin:/bin"})
    write_environment_file(jazzy, env)
    for value, chosen in (("jazzy", jazzy), ("kilted", ready), ("", ready)):
        for script in ("setup/run sh -c 'echo $PYTHONPATH'", ". setup/env.sh && echo $PYTHONPATH"):
            result = shell("bash", script, ready.root, CMP_TACTILE_ROS=value, ROS="robot")
            assert result.stdout == f"{chosen.install}/a/python\n", result.stderr


def test_run_hands_over_arguments_and_exit_status(ready, tmp_path):
    script = f"{ready.root}/setup/run sh -c 'echo \"$1\" $PYTHONPATH; exit 7' sh 'two words'"
    result = shell("sh", script, tmp_path)
    assert result.returncode == 7
    assert result.stdout == f"two words {ready.install}/a/python\n"


def test_a_checkout_that_is_not_set_up_says_so(ready):
    ready.environment_file.unlink()
    for script in ("setup/run true", ". setup/env.sh"):
        result = shell("bash", script, ready.root)
        assert result.returncode == 1
        assert "run 'make build' there first" in result.stderr


def test_a_moved_checkout_says_so(ready, tmp_path):
    moved = tmp_path / "moved"
    ready.root.rename(moved)
    for script in ("setup/run true", ". setup/env.sh"):
        result = shell("bash", script, moved)
        assert result.returncode == 1
        assert f"was set up at {ready.root}" in result.stderr
        assert len(result.stderr.splitlines()) == 1


def test_beside_ros_its_own_setup_file_is_sourced(ready):
    ready.ros = RosInstallation("jazzy", ())
    clean = {"PATH": "/usr/bin:/bin", "AMENT_PREFIX_PATH": "/opt/ros/jazzy"}
    env = build_environment(ready, clean)
    assert env["AMENT_PREFIX_PATH"] == "/opt/ros/jazzy"
    write_environment_file(ready, env)
    script = ". setup/env.sh && echo $AMENT_PREFIX_PATH ${ROS_AUTOMATIC_DISCOVERY_RANGE:-unset}"
    result = shell("bash", script, ready.root, AMENT_PREFIX_PATH="/opt/ros/jazzy")
    assert result.stdout == f"{ready.install}/a:/opt/ros/jazzy unset\n", result.stderr


def test_a_build_inherits_nothing_of_another_ros(layout):
    env = {
        "HOME": "/home/lab",
        "ROS_DISTRO": "noetic",
        "PYTHONPATH": "/opt/ros/noetic/lib/python3/dist-packages",
        "AMENT_PREFIX_PATH": "/other/.venv",
        "CMAKE_PREFIX_PATH": "/other/install",
        "MAKEFLAGS": "-j4 --jobserver-auth=3,4",
        "LD_LIBRARY_PATH": f"{layout.install}/a/lib:/usr/local/cuda/lib64",
    }
    assert clean_environment(env, layout) == {
        "HOME": "/home/lab",
        "LD_LIBRARY_PATH": "/usr/local/cuda/lib64",
    }


def test_a_build_beside_ros_keeps_it_without_an_earlier_build(layout):
    layout.ros = RosInstallation("jazzy", ())
    env = {
        "ROS_DISTRO": "jazzy",
        "AMENT_PREFIX_PATH": f"{layout.install}/a:/opt/ros/jazzy",
        "PYTHONPATH": "/opt/ros/jazzy/lib",
        "MAKEFLAGS": "-j4",
    }
    assert clean_environment(env, layout) == {
        "ROS_DISTRO": "jazzy",
        "AMENT_PREFIX_PATH": "/opt/ros/jazzy",
        "PYTHONPATH": "/opt/ros/jazzy/lib",
    }
