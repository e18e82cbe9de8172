"""Exit codes of commands and what they have printed, in the test's own process or in another."""

import io
import os
import runpy
import subprocess
import sys
from contextlib import redirect_stdout

import pytest


def run(*words: object) -> int:
    """The exit code of `cmp_tactile` with these words, as a shell sees it, in this process."""
    from cmp_tactile_bringup.command import main

    try:
        return main(list(map(str, words)))
    except SystemExit as ended:
        return int(ended.code or 0)


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


def printed_by(script: object, *arguments: object) -> str:
    """What a program prints, in this process: without the seconds in which one of its own loads."""
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as out:
        patch.setattr(sys, "argv", [str(script), *map(str, arguments)])
        runpy.run_path(str(script), run_name="__main__")
    return out.getvalue()


def output_of(*arguments: object, **environment: str | None) -> str:
    """What Python prints, in a process of its own that must end well.

    environment: variables besides those of the test; None: to be unset.
    """
    given = {**os.environ, **environment}
    variables = {name: value for name, value in given.items() if value is not None}
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(
        command, env=variables, stdout=subprocess.PIPE, text=True, check=True
    ).stdout
