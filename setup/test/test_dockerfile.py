"""The Dockerfile of the documentation, read against this repository."""

import re
from pathlib import Path

import pytest

from cmp_tactile_setup import machine
from cmp_tactile_setup.steps import SetupError

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def instructions():
    """Each instruction with its arguments, in order."""
    text = (ROOT / "docs" / "examples" / "Dockerfile").read_text().replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return [tuple(line.split(maxsplit=1)) for line in lines]


def test_it_installs_everything_that_the_set_up_asks_for(instructions, tools, monkeypatch):
    for tool in tools.iterdir():
        tool.unlink()
    monkeypatch.setattr(machine.sysconfig, "get_path", lambda _: "/nowhere")
    monkeypatch.setattr(machine.sys, "version_info", (3, 11, 2))
    with pytest.raises(SetupError) as missing:
        machine.check_tools(for_venv=True, for_wheels=True)
    asked = re.search("apt install ([^']*)'", str(missing.value))[1].split()
    (apt,) = (text for name, text in instructions if name == "RUN" and "apt-get install" in text)
    # Debian's own Python has its headers and venv without the number in the name, too.
    installed = apt.replace("python3-", "python3.11-").split()
    assert set(asked) <= set(installed)
