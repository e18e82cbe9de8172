"""The command: an end by a signal, what it says, and its exit codes."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from waiting import wait_until

from cmp_tactile_processing.cache.files import locked
from paper.blocks import Report
from paper.experiment import Experiment

TRIAL = Path(__file__).parent / "trial"
BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
SECONDS_TO_BEGIN = 60.0


def _start(keys: str, *arguments: str) -> subprocess.Popen[str]:
    paths = [str(TRIAL), str(BENCHMARKS), os.environ.get("PYTHONPATH", "")]
    return subprocess.Popen(
        [sys.executable, "-m", "paper_trial", keys, *arguments],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths), "COLUMNS": "120"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_an_interrupted_run_goes_on_where_it_was(tmp_path: Path) -> None:
    run = _start("lasting", "--output", str(tmp_path), "--jobs", "1")
    kept = tmp_path / "kept"
    wait_until((kept / "lasts").exists, "the first half")
    run.send_signal(signal.SIGINT)
    _, errors = run.communicate(timeout=SECONDS_TO_BEGIN)
    assert run.returncode == 130
    assert "the same command goes on from there" in errors
    assert not (tmp_path / "index.html").exists()
    assert (kept / "calls").read_text() == "half 1\n"

    (kept / "go_on").touch()
    run = _start("lasting", "--output", str(tmp_path), "--jobs", "1")
    output, errors = run.communicate(timeout=SECONDS_TO_BEGIN)
    assert "2 cases, 1 of them kept from an earlier run" in output
    assert (kept / "calls").read_text() == "half 1\n"
    # The claim is not met, which is no failure.
    assert "not met" in output
    assert run.returncode == 0, errors
    assert "not met" in (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "not met" in (tmp_path / "paper.md").read_text(encoding="utf-8")


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The module, in this process; the signals are put back."""
    import paper.__main__ as command
    import paper.runner

    # There is nothing to compile.
    monkeypatch.setattr(paper.runner, "compile_ahead", lambda _: "")
    earlier = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield command
    for number, handler in earlier.items():
        signal.signal(number, handler)


def _experiment(report: Report) -> Experiment:
    return Experiment("a", "I", "A", lambda _: [], lambda *_: report)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_both_signals_end_it(
    command: ModuleType,
    number: signal.Signals,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(command, "_run", lambda *_: signal.raise_signal(number))
    assert command.main([], []) == code
    assert "what is done is kept" in capsys.readouterr().err


def test_a_folder_that_another_run_writes_to_is_refused(
    command: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with locked(tmp_path / ".lock"):
        assert command.main(["--output", str(tmp_path)], []) == 2
    assert "another run is at work there" in capsys.readouterr().err


def test_unknown_experiments_are_named_with_those_that_are(
    command: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    some = [_experiment(Report(()))]
    assert command.main(["--only", "b", "--output", str(tmp_path / "not")], some) == 2
    assert "--only: found b, expected any of: a" in capsys.readouterr().err
    assert not (tmp_path / "not").exists()
    assert command.main(["--list"], some) == 0
    assert capsys.readouterr().out.split() == ["a", "I", "A"]
