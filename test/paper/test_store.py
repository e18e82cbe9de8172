"""Results come back as they were, and never instead of others."""

import logging
import os
from pathlib import Path

import numpy as np
import pytest

from paper.experiment import Case, Workplace
from paper.store import Kept, Store, _code, as_arrays, fingerprint, modules_behind


def _work(place: Workplace, *arguments: object) -> dict[str, float]:
    return {"a": 1.0}


def _other_work(place: Workplace) -> dict[str, float]:
    return {"a": 1.0}


CASE = Case("sphere 1", _work, (1, "x"))
RESULT = {
    "grid": np.arange(12.0).reshape(3, 4).T,
    "picture": np.arange(6, dtype=np.uint8).reshape(2, 3),
    "number": 2.5,
    "label": "Kräfte",
    "file": np.array(["a", "bc"]),
    "none": np.empty((0, 3)),
    "missing": np.nan,
}


def _write(store: Store, case: Case = CASE) -> Path:
    store.write("e", case, Kept(as_arrays(RESULT), 1.5, 1.25), fingerprint(case, fast=False))
    return store.path("e", case)


def test_a_result_comes_back_as_it_was(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.read("e", CASE) is None
    _write(store)
    kept = store.read("e", CASE)
    assert kept is not None
    assert (kept.wall, kept.processor) == (1.5, 1.25)
    assert kept.arrays.keys() == RESULT.keys()
    for name, value in RESULT.items():
        np.testing.assert_array_equal(kept.arrays[name], value)
        assert kept.arrays[name].dtype == np.asarray(value).dtype
    assert [path.name for path in tmp_path.rglob("*.*")] == ["sphere 1.npz"]


@pytest.mark.parametrize("kept_bytes", [0, 10, 300, -1])
def test_a_truncated_file_is_reported_and_computed_again(
    tmp_path: Path, kept_bytes: int, caplog: pytest.LogCaptureFixture
) -> None:
    store = Store(tmp_path)
    path = _write(store)
    path.write_bytes(path.read_bytes()[:kept_bytes])
    with caplog.at_level(logging.WARNING):
        assert store.read("e", CASE) is None
    assert "sphere 1.npz: cannot be used, is computed again" in caplog.text
    _write(store)
    assert store.read("e", CASE) is not None


def test_a_flipped_bit_anywhere_in_the_data_is_noticed(tmp_path: Path) -> None:
    store = Store(tmp_path)
    path = _write(store)
    whole = path.read_bytes()
    place = whole.index(np.arange(12.0).tobytes()[8:16])
    path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
    assert store.read("e", CASE) is None


def test_results_of_other_arguments_functions_and_runs_are_not_taken(tmp_path: Path) -> None:
    store = Store(tmp_path)
    _write(store)
    assert store.read("e", Case("sphere 1", _work, (2, "x"))) is None
    assert store.read("e", Case("sphere 1", _other_work, (1, "x"))) is None
    assert Store(tmp_path, fast=True).read("e", CASE) is None
    assert store.read("e", Case("sphere 1", _work, (1, "x"), seconds=3.0, alone=True)) is not None


def test_results_of_another_simulator_library_or_scene_are_not_taken(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    before = fingerprint(CASE, fast=False)
    monkeypatch.setattr("paper.store.simulator_version", lambda: "another")
    assert fingerprint(CASE, fast=False) != before
    monkeypatch.undo()
    monkeypatch.setattr("paper.store.version", lambda _: "0.1")
    assert fingerprint(CASE, fast=False) != before
    monkeypatch.undo()
    scene = tmp_path / "press.yaml"
    scene.write_text("depth: 1", encoding="utf-8")
    monkeypatch.setattr("paper.store.packaged_scenes", lambda: {"press": scene})
    before = fingerprint(CASE, fast=False)
    scene.write_text("depth: 2", encoding="utf-8")
    assert fingerprint(CASE, fast=False) != before


def test_a_result_that_was_written_unsteadily_never_holds_but_can_be_reported(
    tmp_path: Path,
) -> None:
    store = Store(tmp_path)
    store.write("e", CASE, Kept(as_arrays({"a": 1.0}), 0.0, 0.0), "")
    assert store.read("e", CASE) is None
    assert store.load("e", CASE)["a"] == 1.0


def test_objects_are_refused() -> None:
    with pytest.raises(TypeError, match="b: found dict, expected a number, a text or an array"):
        as_arrays({"a": 1.0, "b": {}})


def test_a_case_rests_on_all_modules_that_it_imports_and_on_no_report() -> None:
    behind = modules_behind("paper.experiments.balls")
    names = {name.removeprefix("paper.") for name in behind}
    assert {"experiments.balls", "readings", "sequence", "dots", "gel", "store"} <= names
    assert not any(name.endswith("_report") or name == "page" for name in names)


def test_a_change_of_code_counts_and_one_of_a_comment_does_not(tmp_path: Path) -> None:
    module = tmp_path / "made_up.py"
    digests = []
    for number, text in enumerate(("a = 1", "a  =  1  # one", "a = 2")):
        module.write_text(text)
        os.utime(module, (number, number))
        digests.append(_code(module))
    assert digests[0] == digests[1] != digests[2]
