"""docs/tutorials/record_replay.md: what it records is there, its other commands are commands."""

import shlex
from pathlib import Path

import pytest
from documents import shell_lines

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")


from cmp_tactile_bringup.commands import parse

TUTORIAL = Path(__file__).resolve().parents[3] / "docs" / "tutorials" / "record_replay.md"


def test_the_commands_are_commands():
    for line in shell_lines(TUTORIAL.read_text(encoding="utf-8")):
        program, *words = shlex.split(line)
        assert program == "cmp_tactile"
        parse(words)
