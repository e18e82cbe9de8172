"""Every check of the machine names what is missing and what to install, in one line."""

import sys
from pathlib import Path

import pytest

from cmp_tactile_setup import machine
from cmp_tactile_setup.steps import SetupError


def write_cmake(tools: Path, version: str) -> None:
    (tools / "cmake").write_text(f"#!/bin/sh\necho 'cmake version {version}'\n")


def check_build_tools():
    machine.check_tools(for_venv=False, for_wheels=False)


def test_all_that_is_missing_is_reported_at_once(tools, monkeypatch, tmp_path):
    """A fresh machine lacks several things; nobody wants to learn of them one by one."""
    for tool in tools.iterdir():
        tool.unlink()
    monkeypatch.setitem(sys.modules, "ensurepip", None)
    monkeypatch.setattr(machine.sysconfig, "get_path", lambda _: str(tmp_path))
    python = f"python3.{sys.version_info.minor}"
    with pytest.raises(SetupError) as caught:
        machine.check_tools(for_venv=True, for_wheels=True)
    assert "not found: C compiler, C++ compiler, make, cmake" in str(caught.value)
    packages = f"gcc g++ make cmake {python}-venv {python}-dev"
    assert f"'sudo apt install {packages}'" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_compiler_named_by_a_variable_must_exist(tools, monkeypatch):
    monkeypatch.setenv("CXX", f"{tools / 'c++'} -march=native")
    check_build_tools()
    monkeypatch.setenv("CXX", "icpx -O3")
    with pytest.raises(SetupError, match="'icpx', which the variable CXX names"):
        check_build_tools()


@pytest.mark.parametrize("version", ["3.16.3", "2.8.12"])
def test_old_cmake_is_named_with_the_version_needed(tools, version):
    write_cmake(tools, version)
    with pytest.raises(SetupError, match=r"cmake \d\.\d+ is too old: install 3\.20 or newer"):
        check_build_tools()


@pytest.mark.parametrize(
    ("name", "named"), [("my robot", "a space"), ("a:b", "':'"), ("it's", '"\'"'), ("$HOME", r"\$")]
)
def test_a_path_that_the_build_tools_cannot_take(name, named):
    with pytest.raises(SetupError, match=named) as caught:
        machine.check_checkout_path(Path("/home/lab") / name)
    assert name in str(caught.value)


@pytest.mark.parametrize("path", ["/home/lab/cmp_tactile-1.0+git", "/home/jörg/触覚", "/a,b=c@d~e"])
def test_ordinary_paths_are_accepted(path):
    machine.check_checkout_path(Path(path))
    with pytest.raises(SetupError):
        machine.check_checkout_path(Path(path + " "))


def add_python(tools: Path, minor: int, status: int = 0) -> None:
    (tools / f"python3.{minor}").write_text(f"#!/bin/sh\nexit {status}\n")
    (tools / f"python3.{minor}").chmod(0o755)


@pytest.fixture
def running(monkeypatch):
    """Sets the Python that the set-up seems to run on."""
    monkeypatch.delenv("PYTHON", raising=False)
    return lambda *version: monkeypatch.setattr(machine.sys, "version_info", (*version, 0))


def test_an_old_python_is_refused_and_a_new_one_tried_with_a_warning(tools, running, capsys):
    add_python(tools, 15)
    running(3, 9)
    with pytest.raises(SetupError, match=r"3\.9 is too old: .* 3\.10 to 3\.14"):
        machine.better_python("kilted")
    assert not capsys.readouterr().out
    running(3, 15)
    assert machine.better_python("kilted") is None
    assert "Python 3.15 is newer than Python 3.10 to 3.14" in capsys.readouterr().out


@pytest.mark.parametrize("minor", [9, 15])
def test_the_newest_supported_python_in_path_takes_the_place_of_another(tools, running, minor):
    for there in (9, 10, 12, 13, 15):
        add_python(tools, there)
    running(3, minor)
    assert machine.better_python("kilted") == str(tools / "python3.13")
    assert machine.better_python("jazzy") == str(tools / "python3.12")


def test_jazzy_has_its_own_python_unless_the_user_names_one(tools, running, monkeypatch):
    running(3, 11)
    assert machine.better_python("jazzy") is None
    add_python(tools, 12)
    assert machine.better_python("kilted") is None
    assert machine.better_python("jazzy") == str(tools / "python3.12")
    monkeypatch.setenv("PYTHON", "python3.11")
    assert machine.better_python("jazzy") is None


def test_an_interpreter_of_pyenv_is_found_although_its_script_in_path_fails(tools, tmp_path):
    """pyenv's script in PATH ends with 127 unless the user has switched that version on."""
    add_python(tools, 12, status=127)
    assert machine.find_python((3, 12)) is None
    for version in ("3.12.1", "3.12.7", "3.11.9"):
        minor = version.rpartition(".")[0]
        installed = tmp_path / "pyenv" / "versions" / version / "bin" / f"python{minor}"
        installed.parent.mkdir(parents=True)
        installed.symlink_to(sys.executable)
    assert machine.find_python((3, 12)) == str(
        tmp_path / "pyenv" / "versions" / "3.12.7" / "bin" / "python3.12"
    )
    assert machine.find_python((3, 13)) is None


@pytest.mark.parametrize(
    ("system", "processor", "libc", "complaint"),
    [
        ("Linux", "aarch64", ("glibc", "2.39"), "x86-64 only, this is Linux on aarch64"),
        ("Darwin", "x86_64", ("", ""), "this is Darwin on x86_64"),
        ("Linux", "x86_64", ("glibc", "2.27"), "need glibc 2.28 or newer, found glibc 2.27"),
        ("Linux", "x86_64", ("", ""), "found another C library"),
    ],
)
def test_platforms_without_wheels(monkeypatch, system, processor, libc, complaint):
    monkeypatch.setattr(machine.platform, "system", lambda: system)
    monkeypatch.setattr(machine.platform, "machine", lambda: processor)
    monkeypatch.setattr(machine.platform, "libc_ver", lambda: libc)
    with pytest.raises(SetupError, match=complaint):
        machine.check_platform()
