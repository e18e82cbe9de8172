"""docs/tutorials/process.md: its commands and programs do what it says, as they stand in it."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from cmp_tactile_bringup.command import build_parser, main

TUTORIAL = Path(__file__).resolve().parents[2] / "docs" / "tutorials" / "process.md"
TEXT = TUTORIAL.read_text(encoding="utf-8")


@pytest.mark.usefixtures("short_scenes", "grasp_bag")
def test_the_commands_and_programs_of_the_tutorial_run(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pyarrow")
    monkeypatch.chdir(tmp_path)
    printed = []
    for kind, block in re.findall(r"^```(sh|python)\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL):
        if kind == "sh":
            assert main(shlex.split(block)[1:]) == 0, block
            capsys.readouterr()
        else:
            exec(compile(block, str(TUTORIAL), "exec"), {})  # noqa: S102  what the reader runs
            printed.append(capsys.readouterr().out.splitlines())
    strongest, fields, columns = printed
    normal, _, deviation, unit = strongest[0].split()
    assert unit == "N"
    assert -20 < float(normal) < -1
    assert 0 < float(deviation) < 1
    assert len(fields) == 20
    # What the nodes' forces sum up to is the wrench.
    assert min(float(line.split()[1]) for line in fields) == pytest.approx(float(normal), abs=0.01)
    assert columns == ["20 N"]
    (listed,) = re.findall(r"^\| file \|.*?\n\n", TEXT, re.MULTILINE | re.DOTALL)
    names = set(re.findall(r"^\| `(.*?)`", listed, re.MULTILINE))
    assert {path.name for path in (tmp_path / "results").iterdir()} == names


def test_the_commands_that_are_shown_and_not_run_have_these_options():
    shown = re.findall(r"^```\n(cmp_tactile.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
    assert len(shown) == 2
    for block in shown:
        build_parser().parse_args(shlex.split(block.replace("\\\n", ""))[1:])


def test_every_option_of_the_command_is_told_in_the_tutorial_or_the_readme(capsys):
    with pytest.raises(SystemExit):
        main(["process", "--help"])
    options = set(re.findall(r"--[a-z-]+", capsys.readouterr().out)) - {"--help", "--debug"}
    readme = (TUTORIAL.parents[2] / "cmp_tactile_bringup" / "README.md").read_text()
    told = set(re.findall(r"--[a-z-]+", TEXT + readme))
    assert options <= told, options - told
