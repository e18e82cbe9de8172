"""The claim of IV.C holds for every object, or it does not hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from paper.blocks import Table
from paper.dot_tracking import ALL_METHODS
from paper.experiments.objects import SCENES
from paper.experiments.objects_report import claims, report

DRAWS, FRAMES, ROWS, COLS, NODES = 2, 3, 5, 6, 31


def made_up(error: float) -> dict[str, np.ndarray]:
    """Results of an object whose markers are all off by `error` (m) along z."""
    heights = np.zeros((NODES, NODES), np.float32)
    data: dict[str, np.ndarray] = {
        "depth": np.array(-6e-4),
        "normal_force": np.array(2.0),
        "extent": np.array([0.003, 0.003]),
        "rest_height": heights,
        "true_height": heights - 6e-4,
        "height": heights - 6e-4 + np.float32(error),
        "displacement": np.zeros((NODES, NODES, 3), np.float32),
    }
    for method in ALL_METHODS:
        errors = np.zeros((DRAWS, 2, ROWS, COLS, 3), np.float32)
        errors[..., 2] = error
        data[f"{method.key}_errors"] = errors
        data[f"{method.key}_all"] = np.tile([0.0, 0.0, error, error], (DRAWS, 1))
        data[f"{method.key}_virtual"] = data[f"{method.key}_all"]
        data[f"{method.key}_frames"] = np.full((DRAWS, FRAMES, 4), error)
        data[f"{method.key}_counts"] = np.tile([60, 57, 1], (DRAWS, 1))
    return data


@pytest.mark.parametrize(("worst", "met"), [(19e-6, True), (21e-6, False)])
def test_one_object_above_the_limit_is_enough_to_miss_it(worst: float, met: bool) -> None:
    results = {scene: made_up(1e-6) for scene in SCENES}
    results[SCENES[3]] = made_up(worst)
    assert [claim.met for claim in claims(results)] == [met, met]
    assert f"{worst * 1e3:.2g} mm" in claims(results)[0].ours


def test_a_method_that_lost_all_markers_meets_nothing() -> None:
    results = {scene: made_up(1e-6) for scene in SCENES}
    results[SCENES[0]]["cmp_all"] = np.full((DRAWS, 4), np.nan)
    assert claims(results)[0].met is False


def test_report_counts_lost_and_wrong_markers_and_draws_its_figures(tmp_path: Path) -> None:
    made = report({scene: made_up(2e-6) for scene in SCENES}, tmp_path)
    table = next(block for block in made.blocks if isinstance(block, Table))
    assert table.rows[-1][2:] == tuple("95.0% / 10" for _ in ALL_METHODS)
    assert table.rows[0][2:] == tuple("2" for _ in ALL_METHODS)
    assert {path.name for path in tmp_path.iterdir()} == {
        "objects_contact.png",
        "objects_press.png",
    }
