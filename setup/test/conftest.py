"""Fixtures of the set-up's tests: a machine with chosen tools, and checkouts to work on."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from cmp_tactile_setup.layout import Layout

SETUP = Path(__file__).resolve().parent.parent


def make_tool(folder: Path, name: str, output: str = "") -> None:
    """An executable of that name that prints `output`."""
    folder.mkdir(exist_ok=True)
    tool = folder / name
    tool.write_text(f"#!/bin/sh\necho '{output}'\n")
    tool.chmod(0o755)


@pytest.fixture
def tools(tmp_path, monkeypatch):
    """A PATH with everything that a build needs and nothing else; tests remove from it."""
    folder = tmp_path / "tools"
    for name in ("cc", "c++", "make"):
        make_tool(folder, name)
    make_tool(folder, "cmake", "cmake version 3.25.1")
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setenv("PYENV_ROOT", str(tmp_path / "pyenv"))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.delenv("CXX", raising=False)
    return folder


@pytest.fixture
def layout(tmp_path):
    """A checkout of the suite with two packages' worth of sources, in a folder of its own."""
    root = tmp_path / "checkout"
    (root / "setup").mkdir(parents=True)
    for requirements in (*SETUP.glob("requirements-*.txt"), *SETUP.glob("locked-*.txt")):
        shutil.copy(requirements, root / "setup")
    for name in ("cmp_tactile_msgs", "cmp_tactile_driver", "cmp_tactile_processing"):
        (root / name).mkdir()
        (root / name / "package.xml").write_text(f"<package><name>{name}</name></package>")
    (root / "cmp_tactile_msgs" / "msg").mkdir()
    (root / "cmp_tactile_msgs" / "msg" / "Grid.msg").write_text("uint16 rows\n")
    bringup = root / "cmp_tactile_bringup"
    (bringup / "cmp_tactile_bringup").mkdir(parents=True)
    (bringup / "cmp_tactile_bringup" / "command.py").write_text("")
    (bringup / "launch").mkdir()
    (bringup / "setup.py").write_text("")
    return Layout(root)


@pytest.fixture
def checkout(tmp_path):
    """Makes a folder of a given name with a copy of this set-up, as a fresh clone has it."""

    def make(name: str) -> Path:
        root = tmp_path / name
        shutil.copytree(SETUP, root / "setup", ignore=shutil.ignore_patterns("test", "__pycache__"))
        return root

    return make
