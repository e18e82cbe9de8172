"""When a virtual environment counts as complete, and what is installed into it."""

import hashlib
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from cmp_tactile_setup import virtual_environment
from cmp_tactile_setup.layout import DISTRIBUTIONS, Layout
from cmp_tactile_setup.machine import PYTHON_NEWEST, PYTHON_OLDEST
from cmp_tactile_setup.steps import SetupError, read_record, write_record

SETUP = Path(__file__).resolve().parent.parent
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
            "requirements": virtual_environment._record(layout)["requirements"],
            "ros": "wheels",
        },
    )
    assert virtual_environment.is_current(layout)
    return layout


@pytest.mark.parametrize("name", ["build", "kilted"])
def test_changed_requirements_are_noticed(complete, name):
    locked = complete.requirements(f"locked-{name}.txt")
    locked.write_text(locked.read_text() + "another-library==1.0\n")
    assert not virtual_environment.is_current(complete)
    assert not virtual_environment.needs_another(complete)


def test_distributions_lie_side_by_side(complete):
    """What is there for one says nothing of another, and no two share a folder."""
    others = [Layout(complete.root, distro) for distro in DISTRIBUTIONS[1:]]
    for other in others:
        assert not virtual_environment.is_current(other)
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


def make_wheel(folder, name, version, *fields, modules=()):
    """Write a wheel with these fields of metadata and these modules; returns its sha256."""
    file = folder / f"{name}-{version}-py3-none-any.whl"
    info = f"{name}-{version}.dist-info"
    metadata = ["Metadata-Version: 2.1", f"Name: {name}", f"Version: {version}", *fields, ""]
    with zipfile.ZipFile(file, "w") as wheel:
        for path, text in modules:
            wheel.writestr(path, text)
        wheel.writestr(f"{info}/METADATA", "\n".join(metadata))
        wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nTag: py3-none-any\n")
        wheel.writestr(f"{info}/RECORD", "")
    return hashlib.sha256(file.read_bytes()).hexdigest()


@pytest.fixture
def index(tmp_path):
    """A folder with one wheel that pip can install; pip looks nowhere else."""
    folder = tmp_path / "index"
    folder.mkdir()
    make_wheel(folder, "probe", "1.0")
    return folder


def uv(*arguments, **variables):
    """Run the uv of this environment; it must succeed or find no registry."""
    command = [sys.executable, "-m", "uv", "pip", *arguments]
    env = {**os.environ, **variables}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    if "error sending request" in done.stderr:
        pytest.skip("the Python package registry cannot be reached")
    assert done.returncode == 0, done.stderr
    return done


PLAIN = ("--quiet", "--no-config", "--no-python-downloads", "--no-header", "--no-annotate")
LINUX = (
    "--python-platform",
    "x86_64-manylinux_2_28",
    "--only-binary",
    ":all:",
    "--no-binary",
    "empy",
)


@pytest.mark.parametrize("python", [PYTHONS[0], PYTHONS[-1]])
@pytest.mark.parametrize("distro", DISTRIBUTIONS)
def test_a_lock_is_complete_and_has_a_wheel_of_each_library(distro, python):
    """Resolved anew with its own versions: nothing is missing, contradicted or without a wheel."""
    lock = str(SETUP / f"locked-{distro}.txt")
    resolved = uv("compile", *PLAIN, *LINUX, "--python-version", python, lock).stdout.split()
    here = (r for r, _ in locked(distro) if applies(r, python))
    assert sorted(resolved) == sorted(f"{r.name}{r.specifier}" for r in here)


# Python and NumPy of the Ubuntu that a distribution is for (its "supported platforms").
BESIDE_ROS = {
    "jazzy": ("3.12", "1.26.4"),
    "kilted": ("3.12", "1.26.4"),
    "lyrical": ("3.14", "2.3.4"),
}


@pytest.mark.parametrize("distro", BESIDE_ROS)
def test_what_a_ros_of_the_system_lacks_can_be_installed_beside_it(distro, tmp_path):
    python, numpy = BESIDE_ROS[distro]
    (tmp_path / "constraints.txt").write_text(f"numpy=={numpy}\n")
    names = ("-c", str(tmp_path / "constraints.txt"), str(SETUP / "requirements-with-ros.txt"))
    found = uv("compile", *PLAIN, *LINUX, "--python-version", python, *names).stdout
    assert f"numpy=={numpy}" in found.split()


# What a new virtual environment has: that of Python 3.11 as it came, the newest, and none: uv.
@pytest.mark.parametrize("installer", ["pip==23.2.1", "pip", "uv"])
def test_each_installer_takes_the_locked_version_where_a_newer_one_is_served(
    layout, installer, capsys
):
    """pip 23.0 to 23.3 look for the newest version of a library that another one wants with an
    extra (pypa/pip 9644 and 12345, pytest-cov 612: `coverage[toml]`), and refuse it then.
    """
    folder = layout.root / "index"
    folder.mkdir()
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", layout.venv], check=True)
    uv("install", "--python", str(layout.venv), installer, *(["pip"] if installer == "uv" else []))
    module = ("numpy/__init__.py", "def get_include(): return ''\n")
    hashes = {
        "wanting": make_wheel(folder, "wanting", "1.0", "Requires-Dist: numpy[more]>=1"),
        "numpy": make_wheel(folder, "numpy", "1.0", "Provides-Extra: more", modules=[module]),
    }
    make_wheel(folder, "numpy", "2.0", "Provides-Extra: more")
    layout.requirements("locked-build.txt").write_text("")
    layout.requirements("locked-kilted.txt").write_text(
        "".join(f"{name}==1.0 --hash=sha256:{digest}\n" for name, digest in hashes.items())
    )
    only_here = {"PIP_CONFIG_FILE": os.devnull, "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(folder)}
    virtual_environment.update_wheels(layout, {**os.environ, **only_here})
    assert read_record(layout.venv_record)
    assert ("installing wheels with pip" in capsys.readouterr().out) == (installer != "uv")
    installed = uv("list", "--python", str(layout.venv), "--format", "freeze").stdout.split()
    assert {"wanting==1.0", "numpy==1.0"} <= set(installed)


@pytest.mark.parametrize(
    ("settings", "variables"),
    [
        ("", {}),
        (
            "global.index-url='https://mirror.lab/simple'",
            {"UV_DEFAULT_INDEX": "https://mirror.lab/simple"},
        ),
        (
            r"global.extra-index-url='\nhttps://a/simple\nhttps://b/simple'",
            {"UV_INDEX": "https://a/simple https://b/simple"},
        ),
        (
            ":env:.index-url='https://c'\nglobal.index-url='https://a'\ninstall.index-url='https://b'",
            {"UV_DEFAULT_INDEX": "https://c"},
        ),
        (
            "global.cert='/etc/lab.pem'\nglobal.timeout='60'\n:env:.find-links='/w /v'",
            {"SSL_CERT_FILE": "/etc/lab.pem", "UV_FIND_LINKS": "/w,/v"},
        ),
    ],
)
def test_uv_looks_where_pip_is_set_to(settings, variables):
    """uv reads no pip.conf (astral-sh/uv 1404, 1859): behind a mirror it would find nothing."""
    assert virtual_environment.uv_variables(settings) == variables


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (f" --hash=sha256:{'0' * 64}", r"probe==1\.0 from \S+/probe-1\.0-\S+\.whl"),
        ("", "Hashes are required"),
    ],
)
def test_a_file_that_is_not_the_locked_one_is_not_installed(complete, index, options, said):
    pip = {"PIP_CONFIG_FILE": os.devnull, "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(index)}
    target = complete.root / "target"
    env = {**os.environ, **pip, "PIP_TARGET": str(target)}
    complete.requirements("locked-build.txt").write_text(f"probe==1.0{options}\n")
    with pytest.raises(SetupError, match=r"build tools failed \(log: \S+/pip\.log\)") as failure:
        virtual_environment.update_wheels(complete, env)
    assert re.search(said, str(failure.value))
    assert not target.exists()
    assert not complete.venv_record.exists()


def test_another_place_or_interpreter_needs_another_environment(complete):
    for key in ("root", "python", "ros"):
        record = read_record(complete.venv_record)
        write_record(complete.venv_record, {**record, key: "another"})
        assert virtual_environment.needs_another(complete)
        write_record(complete.venv_record, record)
    assert not virtual_environment.needs_another(complete)


@pytest.mark.parametrize("name", ["python3.99", "nowhere"])
def test_an_interpreter_that_was_upgraded_or_removed_is_noticed(complete, tmp_path, name):
    """After an upgrade of the system, python3 is another version than the one in lib/."""
    (tmp_path / "python3.99").touch()
    complete.venv_python.unlink()
    complete.venv_python.symlink_to(tmp_path / name)
    assert not virtual_environment.is_current(complete)
    assert virtual_environment.needs_another(complete)


def test_requirements_beside_ros_name_their_modules(layout):
    """Each is looked for by import before it is installed, so each must say by which name."""
    path = layout.requirements("requirements-with-ros.txt")
    found = virtual_environment.read_requirements(path)
    written = [line for line in path.read_text().splitlines() if line and line[0] != "#"]
    assert len(found) == len(written)
    assert ("scikit-fem>=10", "skfem") in found
    assert all(module.isidentifier() for _, module in found)
