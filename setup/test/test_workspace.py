"""What counts as a change that needs a build, and what does not."""

from pathlib import Path

import pytest

from cmp_tactile_setup.machine import RosInstallation
from cmp_tactile_setup.workspace import UNDERLAY, Workspace, explain_build_failure


@pytest.fixture
def built(layout):
    """A checkout that is built as far as its record goes."""
    layout.install.mkdir()
    for name in UNDERLAY:
        (layout.root / "underlay" / name).mkdir(parents=True)
    Workspace.from_layout(layout, None).record_finished()
    assert Workspace.from_layout(layout, None).is_finished()
    return layout


def changed(layout):
    return Workspace.from_layout(layout, None).changed()


@pytest.mark.parametrize(
    ("path", "package"),
    [
        ("cmp_tactile_msgs/package.xml", "cmp_tactile_msgs"),
        ("cmp_tactile_msgs/CMakeLists.txt", "cmp_tactile_msgs"),
        ("cmp_tactile_msgs/msg/Grid.msg", "cmp_tactile_msgs"),
        ("cmp_tactile_msgs/srv/Reset.srv", "cmp_tactile_msgs"),
        ("cmp_tactile_bringup/setup.py", "cmp_tactile_bringup"),
        ("cmp_tactile_bringup/setup.cfg", "cmp_tactile_bringup"),
        ("cmp_tactile_bringup/launch/new.launch.py", "cmp_tactile_bringup"),
        ("cmp_tactile_driver/resource/rclcpp_components/x", "cmp_tactile_driver"),
        ("underlay/tf2_msgs/msg/TFMessage.msg", "tf2_msgs"),
    ],
)
def test_a_change_that_needs_a_build(built, path, package):
    file = built.root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("changed\n")
    assert changed(built) == [package]
    assert not Workspace.from_layout(built, None).is_finished()


def test_an_edited_module_needs_no_build(built):
    """Installed modules are links into the checkout."""
    module = built.root / "cmp_tactile_bringup" / "cmp_tactile_bringup" / "command.py"
    module.write_text("print('edited')\n")
    assert changed(built) == []


def test_a_build_that_failed_is_not_finished(built):
    """Nor where the sources are as they were before again."""
    message = built.root / "cmp_tactile_msgs" / "msg" / "Grid.msg"
    before = message.read_text()
    message.write_text("uint32 rows\n")
    with pytest.raises(FileNotFoundError):  # there is no Python that could run colcon
        Workspace.from_layout(built, None).build(changed(built), {})
    message.write_text(before)
    assert changed(built) == ["cmp_tactile_msgs"]
    assert not Workspace.from_layout(built, None).is_finished()


def test_a_changed_set_up_is_not_finished_but_builds_nothing(built, monkeypatch):
    monkeypatch.setattr("cmp_tactile_setup.workspace._setup_digest", lambda: "another")
    workspace = Workspace.from_layout(built, None)
    assert not workspace.is_finished()
    assert workspace.changed() == []


def test_everything_is_built_again_for_another_ros(built, tmp_path):
    (tmp_path / "share" / "rclpy").mkdir(parents=True)
    (tmp_path / "share" / "rclpy" / "package.xml").touch()
    workspace = Workspace.from_layout(built, RosInstallation("jazzy", (tmp_path,)))
    assert workspace.changed() == list(workspace.digests)


def test_everything_is_built_again_for_other_wheels(built):
    """A library that is only imported may change; one that is compiled against may not."""
    site_packages = built.venv / "lib" / "python3.11" / "site-packages"
    (site_packages / "rich-15.0.0.dist-info").mkdir(parents=True)
    assert changed(built) == []
    (site_packages / "ros_rclpy-9.1.2.dist-info").mkdir()
    assert len(changed(built)) == len(Workspace.from_layout(built, None).digests)


def test_the_underlay_holds_only_what_ros_lacks(built, tmp_path):
    for name in ("tf2_msgs", "tf2_ros_py"):
        (tmp_path / "share" / name).mkdir(parents=True)
        (tmp_path / "share" / name / "package.xml").touch()
    workspace = Workspace.from_layout(built, RosInstallation("jazzy", (Path("/none"), tmp_path)))
    assert workspace.digests.keys() & set(UNDERLAY) == {"composition_interfaces"}


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
