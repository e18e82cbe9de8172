"""A result is to be computed anew when any source that it rests on has changed, and only then."""

import sys
from pathlib import Path
from types import ModuleType

import pytest

from paper.sources import modules_behind, sources_digest

FILES = {
    "__init__.py": "",
    "case.py": "from paper.first import a\n\ndef work(place):\n    from paper import late\n",
    "first.py": "import paper.second as s\nimport numpy as np\na = 1\n",
    "second.py": "from . import third\n",
    "third.py": "c = 3\n",
    "late.py": "d = 4\n",
    "other.py": "e = 5\n",
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    return tmp_path


def _work(place):
    return {}


def _digest(folder: Path) -> str:
    _work.__module__ = "paper.case"
    try:
        return sources_digest(_work, folder)
    finally:
        _work.__module__ = __name__


def test_imports_are_followed_through_modules_and_functions(folder: Path) -> None:
    names = {name.removeprefix("paper.") for name in modules_behind("paper.case", folder)}
    assert names == {"paper", "case", "first", "second", "third", "late"}


@pytest.mark.parametrize("name", ["case", "first", "second", "third", "late"])
def test_a_change_of_code_changes_the_digest(folder: Path, name: str) -> None:
    before = _digest(folder)
    with (folder / f"{name}.py").open("a") as file:
        file.write("z = 1\n")
    assert _digest(folder) != before


def test_other_modules_and_comments_do_not(folder: Path) -> None:
    before = _digest(folder)
    (folder / "other.py").write_text("e = 6\n")
    (folder / "third.py").write_text("# three\nc  =  3\n")
    assert _digest(folder) == before


def test_a_circle_of_imports_ends(folder: Path) -> None:
    (folder / "third.py").write_text("from paper import case\n")
    assert len(modules_behind("paper.case", folder)) == 6


def test_a_function_of_no_file_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "made_up", ModuleType("made_up"))
    with pytest.raises(ModuleNotFoundError, match="made_up: found no source file"):
        modules_behind("made_up")
