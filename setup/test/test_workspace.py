"""What counts as a change that needs a build, and what does not."""

from pathlib import Path

import pytest

from cmp_tactile_setup import workspace
from cmp_tactile_setup.layout import Layout
from cmp_tactile_setup.machine import RosInstallation
from cmp_tactile_setup.steps import read_record
from cmp_tactile_setup.workspace import UNDERLAY, explain_build_failure


@pytest.fixture
def built(layout):
    """A checkout that is built as far as its record goes."""
    layout.install.mkdir()
    for name in UNDERLAY:
        (layout.root / "underlay" / name).mkdir(parents=True)
    workspace.record_finished(layout)
    assert workspace.is_current(layout)
    return layout


@pytest.mark.parametrize(
    "path",
    [
        "cmp_tactile_msgs/package.xml",
        "cmp_tactile_msgs/CMakeLists.txt",
        "cmp_tactile_msgs/msg/Grid.msg",
        "cmp_tactile_msgs/srv/Reset.srv",
        "cmp_tactile_bringup/setup.py",
        "cmp_tactile_bringup/setup.cfg",
        "cmp_tactile_bringup/launch/new.launch.py",
        "cmp_tactile_driver/resource/rclcpp_components/x",
        "underlay/tf2_msgs/msg/TFMessage.msg",
        "setup/cmp_tactile_setup/layout.py",
    ],
)
def test_a_change_that_needs_a_build(built, path):
    file = built.root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("changed\n")
    assert not workspace.is_current(built)
    workspace.clear_outdated(built)
    assert built.install.is_dir()


def test_an_edited_module_needs_no_build(built):
    """Installed modules are links into the checkout."""
    module = built.root / "cmp_tactile_bringup" / "cmp_tactile_bringup" / "command.py"
    module.write_text("print('edited')\n")
    assert workspace.is_current(built)


def test_a_build_that_failed_is_not_finished(built):
    """Nor where the sources are as they were before again."""
    message = built.root / "cmp_tactile_msgs" / "msg" / "Grid.msg"
    before = message.read_text()
    message.write_text("uint32 rows\n")
    with pytest.raises(FileNotFoundError):  # there is no Python that could run colcon
        workspace.build(built, {})
    message.write_text(before)
    assert not workspace.is_current(built)
    workspace.clear_outdated(built)
    assert built.install.is_dir()


def test_everything_is_built_again_for_another_ros(built, tmp_path):
    (tmp_path / "share" / "rclpy").mkdir(parents=True)
    (tmp_path / "share" / "rclpy" / "package.xml").touch()
    other = Layout(built.root, ros=RosInstallation("jazzy", (tmp_path,)))
    assert not workspace.is_current(other)
    workspace.clear_outdated(other)
    assert not built.install.exists()


def test_everything_is_built_again_for_other_wheels(built):
    """A library that is only imported may change; one that is compiled against may not."""
    site_packages = built.venv / "lib" / "python3.11" / "site-packages"
    (site_packages / "rich-15.0.0.dist-info").mkdir(parents=True)
    assert workspace.is_current(built)
    (site_packages / "ros_rclpy-9.1.2.dist-info").mkdir()
    assert not workspace.is_current(built)
    workspace.clear_outdated(built)
    assert not built.install.exists()


def test_messages_are_built_for_cpp_from_the_time_it_is_asked_for(built, monkeypatch):
    monkeypatch.setenv("CMP_TACTILE_CPP", "1")
    asked = Layout(built.root)
    assert not workspace.is_current(asked)
    workspace.record_finished(asked)
    monkeypatch.delenv("CMP_TACTILE_CPP")
    later = Layout(built.root)
    assert later.cpp
    assert workspace.is_current(later)


def test_the_underlay_holds_only_what_ros_lacks(built, tmp_path):
    for name in ("cv_bridge", "tf2_msgs", "tf2_ros_py"):
        (tmp_path / "share" / name).mkdir(parents=True)
        (tmp_path / "share" / name / "package.xml").touch()
    other = Layout(built.root, ros=RosInstallation("jazzy", (Path("/none"), tmp_path)))
    workspace.record_finished(other)
    packages = read_record(built.build_record)["packages"]
    assert set(packages) & set(UNDERLAY) == {"composition_interfaces"}


@pytest.mark.parametrize(
    ("output", "reason"),
    [
        (
            (
                "CMake Error at rosidl_adapt_interfaces.cmake:57 (message):\n"
                "  execute_process(python -m rosidl_adapter) returned error code 1:\n\n"
                "  Error processing 'uint17 rows' of 'cmp_tactile_msgs/Grid'\n"
            ),
            "Error processing 'uint17 rows' of 'cmp_tactile_msgs/Grid'",
        ),
        ("Traceback\n  File x\nSyntaxError: invalid syntax\n", "SyntaxError: invalid syntax"),
        (
            "grid.c:1:10: fatal error: Python.h: No such file or directory\n",
            "grid.c:1:10: fatal error: Python.h: No such file or directory",
        ),
        (
            (
                "CMake Error at CMakeLists.txt:8 (find_package):\n"
                '  Could not find a package configuration file provided by "std_msgz" with any\n'
            ),
            'Could not find a package configuration file provided by "std_msgz" with any',
        ),
        ("CMake Error: no space\n", "CMake Error: no space"),
        ("Killed\n", "no reason given"),
    ],
)
def test_the_reason_why_a_build_failed(output, reason):
    output = f"Starting >>> cmp_tactile_msgs\n{output}Failed   <<< cmp_tactile_msgs [0.51s]\n"
    line = explain_build_failure(output, Path("/log/build.log"))
    assert line == f"building cmp_tactile_msgs failed: {reason} (log: /log/build.log)"
