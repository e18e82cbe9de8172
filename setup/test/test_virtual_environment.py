"""When a virtual environment counts as complete, and what is said when pip fails."""

import re
import sys
from pathlib import Path

import pytest

from cmp_tactile_setup import virtual_environment
from cmp_tactile_setup.layout import DISTRIBUTIONS, Layout
from cmp_tactile_setup.record import read_record, write_record
from cmp_tactile_setup.ros_installation import RosInstallation

LOG = Path("/checkout/log/pip.log")


@pytest.fixture
def complete(layout):
    """A checkout whose virtual environment is complete as far as its record goes."""
    layout.venv_python.parent.mkdir(parents=True)
    layout.venv_python.symlink_to(sys.executable)
    write_record(
        layout.venv_record,
        {
            "root": str(layout.root),
            "python": str(layout.venv_python.resolve()),
            "requirements": virtual_environment._record(layout, None)["requirements"],
            "ros": "wheels",
        },
    )
    assert virtual_environment.is_current(layout, None)
    return layout


def test_an_interrupted_one_is_not_current(layout):
    """pip was stopped half-way: the interpreter is there, the record is not."""
    layout.venv_python.parent.mkdir(parents=True)
    layout.venv_python.symlink_to(sys.executable)
    assert not virtual_environment.is_current(layout, None)


def test_a_cut_off_record_is_none(complete):
    text = complete.venv_record.read_text()
    complete.venv_record.write_text(text[: len(text) // 2])
    assert read_record(complete.venv_record) == {}
    assert not virtual_environment.is_current(complete, None)


def test_changed_requirements_are_noticed(complete):
    requirements = complete.requirements("requirements-kilted.txt")
    requirements.write_text(requirements.read_text() + "another-library==1.0\n")
    assert not virtual_environment.is_current(complete, None)
    assert not virtual_environment.needs_another(complete, None)


def test_changed_libraries_are_noticed(complete):
    libraries = complete.requirements("requirements-libraries.txt")
    libraries.write_text(libraries.read_text() + "another-library==1.0\n")
    assert not virtual_environment.is_current(complete, None)


def test_distributions_lie_side_by_side(complete):
    """What is there for one says nothing of another, and no two share a folder."""
    others = [Layout(complete.root, distro) for distro in DISTRIBUTIONS[1:]]
    for other in others:
        assert not virtual_environment.is_current(other, None)
    for part in ("venv", "install", "build", "logs"):
        folders = {getattr(layout, part) for layout in (complete, *others)}
        assert len(folders) == len(DISTRIBUTIONS)


@pytest.mark.parametrize("name", [*DISTRIBUTIONS, "libraries"])
def test_every_wheel_has_one_version(layout, name):
    """A version that is left open would make two machines differ."""
    lines = layout.requirements(f"requirements-{name}.txt").read_text().splitlines()
    pins = [line.partition("#")[0] for line in lines if line.partition("#")[0].strip()]
    assert pins
    for pin in pins:
        assert re.fullmatch(r"[\w\-]+(\[\w+\])?==[\w.]+(; python_version [<>=]+ '3\.\d+')?", pin)


def test_another_place_or_interpreter_needs_another_environment(complete):
    for key in ("root", "python", "ros"):
        record = read_record(complete.venv_record)
        write_record(complete.venv_record, {**record, key: "another"})
        assert virtual_environment.needs_another(complete, None)
        write_record(complete.venv_record, record)
    assert not virtual_environment.needs_another(complete, None)


def test_a_vanished_interpreter_is_noticed(complete):
    complete.venv_python.unlink()
    complete.venv_python.symlink_to("/nowhere/python3")
    assert not virtual_environment.is_current(complete, None)
    assert virtual_environment.needs_another(complete, None)


def test_an_upgraded_interpreter_is_noticed(complete, tmp_path):
    """After an upgrade of the system, python3 is another version than the one in lib/."""
    newer = tmp_path / "python3.99"
    newer.touch()
    complete.venv_python.unlink()
    complete.venv_python.symlink_to(newer)
    assert not virtual_environment.is_current(complete, None)


def test_wheels_do_not_serve_beside_ros(complete):
    ros = RosInstallation("jazzy", (Path("/opt/ros/jazzy"),))
    assert not virtual_environment.is_current(complete, ros)


@pytest.mark.parametrize(
    ("output", "said"),
    [
        ("WARNING: Retrying after NewConnectionError\nERROR: No match", "cannot be reached"),
        ("ERROR: OSError: [Errno 28] No space left on device", "disk is full"),
        (
            "Collecting x\nERROR: Cannot install a and b because of conflicts\nERROR: more",
            "Cannot install a and b because of conflicts (log",
        ),
        ("Killed", "no reason given"),
    ],
)
def test_the_reason_why_pip_failed(output, said):
    line = virtual_environment.explain_pip_failure(output, LOG)
    assert said in line
    assert line.endswith(f"(log: {LOG})")
    assert "\n" not in line


def test_requirements_beside_ros_name_their_modules(layout):
    """Each is looked for by import before it is installed, so each must say by which name."""
    path = layout.requirements("requirements-with-ros.txt")
    found = virtual_environment.read_requirements(path)
    written = [line for line in path.read_text().splitlines() if line and line[0] != "#"]
    assert len(found) == len(written)
    assert ("scikit-fem>=10", "skfem") in found
    assert all(module.isidentifier() for _, module in found)
