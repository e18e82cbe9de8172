"""Cases are computed once, as long as their arguments and sources stay; failures are named."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from paper.__main__ import run
from paper.lab import Lab, Workplace, digest_of

TRIAL = '''"""A case that counts its calls."""

import numpy as np


def half(place, number):
    with (place.folder / "calls").open("a") as calls:
        calls.write(f"{number} ")
    return {"half": np.array(number) / 2}
'''


@pytest.fixture
def trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A module of an experiment, in a folder that other processes know."""
    (tmp_path / "paper_trial.py").write_text(TRIAL)
    monkeypatch.syspath_prepend(tmp_path)
    import paper_trial

    yield paper_trial
    del sys.modules["paper_trial"]


def _halves(lab: Lab, trial, *numbers: int) -> list[float]:
    found = lab.compute(trial.half, [(number,) for number in numbers])
    return [float(result["half"]) for result in found]


def test_results_are_in_order_and_kept(trial, tmp_path: Path) -> None:
    lab, calls = Lab(Workplace(tmp_path), 1), tmp_path / "calls"
    assert _halves(lab, trial, 3, 1) == [1.5, 0.5]
    assert _halves(lab, trial, 1, 4, 3) == [0.5, 2.0, 1.5]
    assert calls.read_text().split() == ["3", "1", "4"]
    # The quick run has results of its own.
    assert _halves(Lab(Workplace(tmp_path, fast=True), 1), trial, 1) == [0.5]
    assert calls.read_text().split()[-1] == "1"


def test_a_change_of_the_sources_counts(trial, tmp_path: Path) -> None:
    before = digest_of("paper_trial")
    assert before == digest_of("paper_trial")
    (tmp_path / "paper_trial.py").write_text(TRIAL + "\nOTHER = 1\n")
    assert digest_of("paper_trial") != before


def test_an_experiment_that_fails_is_named_and_the_others_are_on_the_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(lab, page):
        raise ValueError("no gel")

    def works(lab, page):
        page.claim("reliability.light", met=True, range="works")
        page.rows(("a",), ((f"{np.pi:.2f}",),))

    experiments = {
        "bad": SimpleNamespace(TITLE="I: Bad", run=fails),
        "good": SimpleNamespace(TITLE="II: Good", run=works),
    }
    assert run(experiments, Lab(Workplace(tmp_path), 1), tmp_path) == 1
    page = (tmp_path / "paper.md").read_text(encoding="utf-8")
    assert "This section is incomplete: ValueError: no gel" in page
    assert "| 3.14 |" in page
    assert "1 claims: 1 met" in page
    assert "failed: bad" in capsys.readouterr().err
