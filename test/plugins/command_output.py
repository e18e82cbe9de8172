"""What a command that ran in the test's own process has printed."""

from __future__ import annotations

import pytest


def printed(capsys: pytest.CaptureFixture[str]) -> str:
    """All of it, on one line; without a traceback."""
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    return " ".join((captured.out + captured.err).split())


def one_line_error(capsys: pytest.CaptureFixture[str], *expected: str) -> None:
    """The only line on stderr that is an error has these texts; without a traceback."""
    err = capsys.readouterr().err
    assert "Traceback" not in err
    (line,) = (line for line in err.splitlines() if line.startswith("error:"))
    for text in expected:
        assert text in line
