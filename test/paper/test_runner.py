"""From experiments to results: what fails is named, what is done is kept."""

import shutil
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from cmp_tactile_simulation.scenes.file import load_scene
from paper import gel
from paper.experiment import Case, Experiment, Workplace
from paper.pool import Display
from paper.runner import ExperimentResult, Plan, run_plan


def _run(folder: Path, *experiments: Experiment) -> dict[str, ExperimentResult]:
    place = Workplace(folder / "kept")
    with Display(Console(quiet=True), 1.0, 1) as display:
        results = run_plan(Plan(experiments, folder, place), 2, display)
    return {result.experiment.key: result for result in results}


def test_what_fails_is_named_and_the_rest_is_there_and_kept(trial: Any, tmp_path: Path) -> None:
    results = _run(tmp_path, trial.BAD, trial.GOOD, trial.SPEECHLESS)
    assert results["bad"].report is None
    (failure,) = results["bad"].failures
    assert (failure.name, failure.error) == ("case bad", "RuntimeError: no <luck> | here")
    assert results["speechless"].report is None
    (failure,) = results["speechless"].failures
    assert (failure.name, failure.error) == ("report", "ValueError: no figure")
    report = results["good"].report
    assert report is not None
    assert report.claims[0].ours == "2"
    assert (tmp_path / "figures" / "good" / "pixel.png").exists()
    assert {cost.case: cost.kept for cost in results["good"].costs} == {"one": False, "rest": False}

    # Again: only what failed is tried once more, and a damaged result is computed again.
    before = (tmp_path / "kept" / "calls").read_text().splitlines()
    kept = tmp_path / "kept" / "results" / "good" / "rest.npz"
    kept.write_bytes(kept.read_bytes()[:-5])
    shutil.rmtree(tmp_path / "figures")
    results = _run(tmp_path, trial.BAD, trial.GOOD)
    assert len(results["bad"].failures) == 1
    assert {cost.case: cost.kept for cost in results["good"].costs} == {"one": True, "rest": False}
    assert results["good"].report == report
    calls = (tmp_path / "kept" / "calls").read_text().splitlines()
    assert calls[len(before) :] == ["half 3"]


def test_two_cases_of_one_name_are_refused(trial: Any, tmp_path: Path) -> None:
    def cases(place: Workplace) -> list[Case]:
        return [Case("one", trial.half, (1,)), Case("one", trial.half, (2,))]

    twice = Experiment("twice", "", "Twice", cases, trial.report)
    with pytest.raises(ValueError, match="twice: found two cases of the name 'one'"):
        Plan([twice], tmp_path, Workplace(tmp_path))


def test_a_damaged_contact_is_solved_again(tmp_path: Path) -> None:
    scene = load_scene("contact_sphere")
    place = Workplace(tmp_path)
    name = f"mechanics-{scene.name}-{gel._key(scene)}.npz"
    (tmp_path / name).write_bytes(b"PK, and then no more")
    solved = {"displacement": np.zeros((2, 4, 5, 3)), "extent": np.array([1.0, 2.0])}
    others = {f.name for f in fields(gel.Mechanics)} - {*solved, "observers", "rate"}
    with pytest.MonkeyPatch.context() as patch:
        whole = solved | {other: np.zeros(2) for other in others}
        patch.setattr(gel, "_solved", lambda _scene, _place: dict(whole))
        assert len(gel.mechanics_of(scene, place)) == 2
        patch.setattr(gel, "_solved", lambda *_: pytest.fail("was solved twice"))
        found = gel.mechanics_of(scene, place)
    assert (found.observers.rows, found.observers.extent) == (4, (1.0, 2.0))
