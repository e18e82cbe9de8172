"""Other processes of this software run nothing of the folder that a user stands in."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from cmp_tactile_processing import processes as module
from cmp_tactile_processing.processes import python_command

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = ("cmp_tactile_*/cmp_tactile_*", "cmp_tactile_bringup/launch", "benchmarks/paper")
# Says who has run it, and fails.
TRAP = "open(__file__ + '.ran', 'w').close()\nraise ImportError(__file__)\n"
OTHERS = ("numpy", "yaml", "rclpy", "cv2", "numba", "cmp_tactile_processing", "sitecustomize")


@pytest.fixture
def traps(tmp_path, monkeypatch) -> Path:
    """The current folder, with a file for every module that may be looked for in it."""
    folder = tmp_path / "downloaded"
    folder.mkdir()
    for name in (*sys.stdlib_module_names, *OTHERS):
        (folder / f"{name}.py").write_text(TRAP)
    monkeypatch.chdir(folder)
    return folder


def sprung(folder: Path) -> list[str]:
    return [path.name for path in folder.glob("*.ran")]


# As on Python 3.10, which has no option for it.  Python 3.13 imports before it runs such a line.
OLD = pytest.mark.skipif(sys.version_info >= (3, 13), reason="for Python 3.10")


@pytest.mark.parametrize("version", [sys.version_info, pytest.param((3, 10), marks=OLD)])
def test_nothing_of_the_current_folder_is_run(version, traps, tmp_path, monkeypatch):
    (tmp_path / "printed.py").write_text(
        "import json, pickle, signal, socket, sys, threading\n"
        "if __name__ == '__main__':\n"
        "    print(sys.argv[1:])\n"
        "    sys.exit(7)\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    faked = SimpleNamespace(version_info=version, executable=sys.executable)
    monkeypatch.setattr(module, "sys", faked)
    command = python_command("printed", "a", "b c")
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (7, "['a', 'b c']\n"), done.stderr
    assert sprung(traps) == []


def sources() -> Iterator[Path]:
    for pattern in SHIPPED:
        for folder in ROOT.glob(pattern):
            yield from folder.rglob("*.py")


def test_all_processes_are_started_so():
    """What multiprocessing starts looks for modules in the current folder, too.

    The workers of `process` begin in another one, which their own test shows.
    """
    wrong = ("sys.executable", "get_context", "multiprocessing.Process", "ProcessPoolExecutor")
    found = {
        path.name: [word for word in wrong if word in text]
        for path in sources()
        if path.name != "workers.py"
        for text in [path.read_text(encoding="utf-8")]
        if any(word in text for word in wrong)
    }
    assert found == {"processes.py": ["sys.executable"]}
