"""Commands that documents show are commands with these options, and each option is documented."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_output import run
from documents import blocks

from cmp_tactile_bringup.commands import parse

ROOT = Path(__file__).resolve().parents[3]
DOCUMENTS = ("*.md", "docs/**/*.md", "*/README.md")
OPTION = re.compile(r"--[a-z-]+")
# Documents of commands with many options.
PAGES = {
    "pattern": ("docs/print.md",),
    "process": (
        "docs/tutorials/process.md",
        "docs/process_results.md",
        "docs/recordings.md",
        "cmp_tactile_bringup/README.md",
    ),
}


def shown_commands(path: Path) -> Iterator[list[str]]:
    """Words of the command lines in a document's blocks, without `cmp_tactile`."""
    for block in blocks(path.read_text(encoding="utf-8"), "(?:sh)?"):
        for line in block.replace("\\\n", " ").splitlines():
            if line.startswith("cmp_tactile "):
                command = re.split(r"\s[|>]\s", line)[0]
                yield shlex.split(command, comments=True)[1:]


def test_every_command_that_is_shown_can_be_given():
    count = 0
    for path in (path for pattern in DOCUMENTS for path in ROOT.glob(pattern)):
        for words in shown_commands(path):
            assert parse(words), path
            count += 1
    assert count >= 60


@pytest.mark.parametrize("command", PAGES)
def test_every_option_is_in_a_document(command, capsys):
    assert run(command, "--help") == 0
    options = set(OPTION.findall(capsys.readouterr().out)) - {"--help", "--debug"}
    text = "".join((ROOT / page).read_text(encoding="utf-8") for page in PAGES[command])
    assert options <= set(OPTION.findall(text))
