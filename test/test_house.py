"""The figures of the house, on a small one that was counted by hand."""

import subprocess

import pytest
from house import measure

MODULE = '''"""What it does.

Over some lines.
"""

import os
from pathlib import (
    Path,
)

__all__ = ["name"]  # 5 lines so far


# A comment.
def name(path: Path) -> str:
    """Docstring."""

    def inner() -> None:
        os.getcwd()

    inner()
    return (
        """text"""
        f"{path}"
    )
'''


@pytest.fixture
def checkout(tmp_path):
    files = {
        "cmp_tactile_a/cmp_tactile_a/module.py": MODULE,
        "cmp_tactile_a/cmp_tactile_a/__init__.py": '"""A room."""\n',
        "cmp_tactile_a/setup.py": "import os\n",
        "cmp_tactile_a/test/test_module.py": "x = 1\ny = 2\n",
        "conftest.py": "z = 3\n",
        "benchmarks/speed.py": "x = 1\n",
        "docs/example.py": "x = 1\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    for command in (["init", "-q"], ["add", "-A"]):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    (tmp_path / "cmp_tactile_a" / "unknown_to_git.py").write_text("x = 1\n")
    return tmp_path


def test_a_small_house(checkout):
    assert measure(checkout) == {
        "shipped source lines": 13,
        "shipped modules": 2,
        "modules of 40 source lines or fewer": 1,
        "source lines of benchmarks": 1,
        "source lines of tests": 3,
        "imports and __all__, %": round(100 * 5 / 13, 1),
        "modules of the largest folder": 2,
        "largest folder": "cmp_tactile_a/cmp_tactile_a",
        "90 % of the functions are below": 8,
        "longest function": 8,
    }
