"""When a virtual environment counts as complete, and what is said when pip fails."""

import os
import re
import sys
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from cmp_tactile_setup import virtual_environment
from cmp_tactile_setup.layout import DISTRIBUTIONS, Layout
from cmp_tactile_setup.machine import PYTHON_NEWEST, PYTHON_OLDEST, RosInstallation
from cmp_tactile_setup.steps import SetupError, read_record, write_record

SETUP = Path(__file__).resolve().parent.parent
LOG = Path("/checkout/log/pip.log")
PYTHONS = [f"3.{minor}" for minor in range(PYTHON_OLDEST[1], PYTHON_NEWEST[1] + 1)]


@pytest.fixture
def complete(layout):
    """A checkout with a virtual environment that is complete by its record."""
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


@pytest.mark.parametrize("name", ["build", "kilted"])
def test_changed_requirements_are_noticed(complete, name):
    locked = complete.requirements(f"locked-{name}.txt")
    locked.write_text(locked.read_text() + "another-library==1.0\n")
    assert not virtual_environment.is_current(complete, None)
    assert not virtual_environment.needs_another(complete, None)


def test_distributions_lie_side_by_side(complete):
    """What is there for one says nothing of another, and no two share a folder."""
    others = [Layout(complete.root, distro) for distro in DISTRIBUTIONS[1:]]
    for other in others:
        assert not virtual_environment.is_current(other, None)
    for part in ("venv", "install", "build", "logs"):
        folders = {getattr(layout, part) for layout in (complete, *others)}
        assert len(folders) == len(DISTRIBUTIONS)


def wanted(*names):
    """Requirements that people have written, from some of the files."""
    paths = [SETUP / f"requirements-{name}.txt" for name in names]
    lines = [line.partition("#")[0] for path in paths for line in path.read_text().splitlines()]
    return [Requirement(line) for line in lines if line.strip()]


def locked(name):
    """Each requirement of a locked file, with its hashes."""
    text = (SETUP / f"locked-{name}.txt").read_text().replace("\\\n", " ")
    lines = [line.partition("#")[0] for line in text.splitlines()]
    for requirement, *hashes in (line.split(" --hash=") for line in lines if line.strip()):
        yield Requirement(requirement), [digest.strip() for digest in hashes]


def applies(requirement, python):
    environment = {"python_version": python, "python_full_version": f"{python}.1"}
    return requirement.marker is None or requirement.marker.evaluate(environment)


LOCKED = {
    "build": ["build"],
    **{distro: ["build", distro, "libraries"] for distro in DISTRIBUTIONS},
}


@pytest.mark.parametrize("name", LOCKED)
def test_every_locked_requirement_has_one_version_and_hashes(name):
    """A version that is left open, or a file that nothing vouches for, would go in unseen."""
    for requirement, hashes in locked(name):
        assert re.fullmatch(r"==[\w.]+", str(requirement.specifier)), requirement
        assert hashes, requirement
        assert all(re.fullmatch("sha256:[0-9a-f]{64}", digest) for digest in hashes), requirement


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("name", LOCKED)
def test_locked_versions_are_those_that_are_wanted(name, python):
    """'make lock' was run after the last change of what people write."""
    versions = {
        canonicalize_name(requirement.name): str(requirement.specifier).removeprefix("==")
        for requirement, _ in locked(name)
        if applies(requirement, python)
    }
    for requirement in wanted(*LOCKED[name]):
        if applies(requirement, python):
            version = versions[canonicalize_name(requirement.name)]
            assert requirement.specifier.contains(version), requirement


@pytest.fixture
def index(tmp_path):
    """A folder with one wheel that pip can install; pip looks nowhere else."""
    folder = tmp_path / "index"
    folder.mkdir()
    with zipfile.ZipFile(folder / "probe-1.0-py3-none-any.whl", "w") as wheel:
        info = "probe-1.0.dist-info"
        wheel.writestr(f"{info}/METADATA", "Metadata-Version: 2.1\nName: probe\nVersion: 1.0\n")
        wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nTag: py3-none-any\n")
        wheel.writestr(f"{info}/RECORD", "")
    return folder


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            f" --hash=sha256:{'0' * 64}",
            r"^probe==1\.0: the sha256 of \S+/probe-1\.0-\S+\.whl is not",
        ),
        ("", r"^probe: has no version and sha256 in .* run 'make lock'"),
    ],
)
def test_a_file_that_is_not_the_locked_one_is_not_installed(complete, index, options, said):
    pip = {"PIP_CONFIG_FILE": os.devnull, "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(index)}
    target = complete.root / "target"
    env = {**os.environ, **pip, "PIP_TARGET": str(target)}
    complete.requirements("locked-build.txt").write_text(f"probe==1.0{options}\n")
    with pytest.raises(SetupError, match=said) as failure:
        virtual_environment.update_wheels(complete, env)
    assert "\n" not in str(failure.value)
    assert not target.exists()
    assert not complete.venv_record.exists()


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
