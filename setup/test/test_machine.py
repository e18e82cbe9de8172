"""Every check of the machine names what is missing and what to install, in one line."""

import sys
from pathlib import Path

import pytest

from cmp_tactile_setup import machine
from cmp_tactile_setup.errors import SetupError


def write_cmake(tools: Path, version: str) -> None:
    (tools / "cmake").write_text(f"#!/bin/sh\necho 'cmake version {version}'\n")


def test_complete_tools_are_accepted(tools):
    machine.check_build_tools()
    assert sorted(path.name for path in tools.iterdir()) == ["c++", "cc", "cmake", "make"]


@pytest.mark.parametrize(
    ("tool", "what", "package"),
    [
        ("cc", "C compiler", "gcc"),
        ("c++", "C++ compiler", r"g\+\+"),
        ("make", "make", "make"),
        ("cmake", "cmake", "cmake"),
    ],
)
def test_each_missing_tool_is_named_with_its_package(tools, tool, what, package):
    (tools / tool).unlink()
    with pytest.raises(SetupError, match=f"not found: .*apt install {package};") as caught:
        machine.check_build_tools()
    assert str(caught.value).startswith(what)
    assert "\n" not in str(caught.value)


def test_another_compiler_counts(tools):
    (tools / "cc").rename(tools / "clang")
    (tools / "c++").rename(tools / "clang++")
    machine.check_build_tools()
    (tools / "clang").unlink()
    with pytest.raises(SetupError, match="C compiler not found"):
        machine.check_build_tools()


def test_a_compiler_named_by_a_variable_must_exist(tools, monkeypatch):
    monkeypatch.setenv("CXX", f"{tools / 'c++'} -march=native")
    machine.check_build_tools()
    monkeypatch.setenv("CXX", "icpx -O3")
    with pytest.raises(SetupError, match="'icpx' that the variable CXX names"):
        machine.check_build_tools()


@pytest.mark.parametrize("version", ["3.16.3", "2.8.12"])
def test_old_cmake_is_named_with_the_version_needed(tools, version):
    write_cmake(tools, version)
    with pytest.raises(SetupError, match=r"cmake \d\.\d+ .*too old: install 3\.20 or newer"):
        machine.check_build_tools()


@pytest.mark.parametrize("version", ["3.20.0", "3.100.1", "4.0.2"])
def test_newer_cmake_is_accepted(tools, version):
    write_cmake(tools, version)
    machine.check_build_tools()


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


def test_a_moved_checkout_is_told_both_places_and_what_to_do(tmp_path):
    with pytest.raises(SetupError, match=rf"/old/place.*now at {tmp_path}.*'make clean'"):
        machine.check_not_moved(tmp_path, "/old/place")
    machine.check_not_moved(tmp_path, str(tmp_path))
    machine.check_not_moved(tmp_path, None)


def test_supported_versions_of_python():
    supported = [minor for minor in range(6, 20) if machine.is_supported_python((3, minor))]
    assert supported == [10, 11, 12, 13]


def test_unsupported_python_names_the_supported_ones():
    assert "Python 3.14 is not supported: install one of Python 3.10 to 3.13" in str(
        machine.unsupported_python((3, 14))
    )


def test_the_newest_supported_python_in_path_is_found(tools):
    assert machine.other_supported_python() is None
    for minor in (9, 10, 12, 14):
        (tools / f"python3.{minor}").write_text("#!/bin/sh\n")
        (tools / f"python3.{minor}").chmod(0o755)
    assert machine.other_supported_python() == str(tools / "python3.12")


@pytest.mark.parametrize(
    ("system", "processor", "libc", "complaint"),
    [
        ("Linux", "aarch64", ("glibc", "2.39"), "x86-64 only, this is Linux on aarch64"),
        ("Darwin", "x86_64", ("", ""), "this is Darwin on x86_64"),
        ("Linux", "x86_64", ("glibc", "2.17"), "need glibc 2.28 or newer, found glibc 2.17"),
        ("Linux", "x86_64", ("", ""), "found another C library"),
    ],
)
def test_platforms_without_wheels(monkeypatch, system, processor, libc, complaint):
    monkeypatch.setattr(machine.platform, "system", lambda: system)
    monkeypatch.setattr(machine.platform, "machine", lambda: processor)
    monkeypatch.setattr(machine.platform, "libc_ver", lambda: libc)
    with pytest.raises(SetupError, match=complaint):
        machine.check_platform()


def test_the_platform_with_wheels(monkeypatch):
    monkeypatch.setattr(machine.platform, "system", lambda: "Linux")
    monkeypatch.setattr(machine.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(machine.platform, "libc_ver", lambda: ("glibc", "2.28"))
    machine.check_platform()
    monkeypatch.setattr(machine.platform, "libc_ver", lambda: ("glibc", "2.27"))
    with pytest.raises(SetupError):
        machine.check_platform()


@pytest.mark.parametrize("module", ["venv", "ensurepip"])
def test_a_missing_venv_module_is_named_with_its_package(monkeypatch, module):
    machine.check_venv()
    monkeypatch.setitem(sys.modules, module, None)
    minor = sys.version_info.minor
    with pytest.raises(SetupError, match=rf"'{module}' is missing.*python3\.{minor}-venv"):
        machine.check_venv()


def test_missing_headers_are_named_with_their_package(monkeypatch, tmp_path):
    monkeypatch.setattr(machine.sysconfig, "get_path", lambda _: str(tmp_path))
    with pytest.raises(SetupError, match=r"headers are missing.*-dev"):
        machine.check_python_headers()
    (tmp_path / "Python.h").touch()
    machine.check_python_headers()
