"""Failures are found where they are, and claims follow from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from paper.blocks import Figure
from paper.dot_tracking import ALL_METHODS
from paper.experiment import Arrays
from paper.experiments.reliability import SWEEPS
from paper.experiments.reliability_report import Endurance, claims, endurances_of, limits, report

VISIBLE, FRAMES, REPETITIONS = 100, 4, 2


def _arrays(levels: tuple[float, ...], found: dict[str, list[int]]) -> Arrays:
    """Results with these counts of found markers, by method and level, in the worst frame."""
    shape = len(levels), REPETITIONS, FRAMES
    arrays: dict[str, np.ndarray] = {
        "levels": np.array(levels),
        "strips": np.zeros((len(levels), 60, 30), np.uint8),
    }
    for method, counts in found.items():
        all_found = np.full(shape, VISIBLE)
        all_found[:, -1, -1] = counts
        arrays |= {
            f"{method}_found": all_found,
            f"{method}_wrong": np.zeros(shape, int),
            f"{method}_visible": np.full(shape, VISIBLE),
            f"{method}_error": np.full(shape, 1e-6),
            f"{method}_referenced": np.ones(shape[:2], bool),
        }
    return arrays


def test_one_marker_lost_in_one_frame_is_a_failure() -> None:
    endurance = Endurance.from_arrays(_arrays((0.0, 0.1, 0.2), {"cmp": [100, 99, 100]}), "cmp")
    assert endurance.fails_at == 1
    assert endurance.bears == 0.0
    assert endurance.success == pytest.approx([1, 7 / 8, 1])
    assert endurance.half_lost_at is None


def test_a_wrong_number_is_a_failure_though_every_marker_is_found() -> None:
    arrays = dict(_arrays((0.0, 0.1), {"cmp": [100, 100]}))
    wrong = arrays["cmp_wrong"].copy()
    wrong[1, 0, 2] = 1
    endurance = Endurance.from_arrays({**arrays, "cmp_wrong": wrong}, "cmp")
    assert endurance.fails_at == 1
    assert endurance.wrong.tolist() == [0, 1]


def test_a_level_without_reference_is_a_failure() -> None:
    arrays = dict(_arrays((0.0, 0.1), {"cmp": [100, 100]}))
    arrays["cmp_referenced"] = np.array([[True, True], [True, False]])
    endurance = Endurance.from_arrays(arrays, "cmp")
    assert endurance.fails_at == 1
    assert endurance.success == pytest.approx([1, 1 / 2])


def test_half_of_the_markers_is_counted_over_all_frames() -> None:
    arrays = dict(_arrays((0.0, 0.1, 0.2), {"cmp": [100, 100, 100]}))
    arrays["cmp_found"] = np.array([100, 51, 50])[:, None, None] * np.ones((3, 2, 4), int)
    assert Endurance.from_arrays(arrays, "cmp").half_lost_at == 2


def test_nothing_fails_and_all_fails() -> None:
    arrays = _arrays((0.0, 0.1), {"cmp": [100, 100], "dmp_grid": [0, 0]})
    cmp, dots = Endurance.from_arrays(arrays, "cmp"), Endurance.from_arrays(arrays, "dmp_grid")
    assert (cmp.fails_at, cmp.bears) == (None, 0.1)
    assert (dots.fails_at, dots.bears) == (0, None)


def test_levels_without_any_reference_have_no_error() -> None:
    arrays = dict(_arrays((0.0, 0.1), {"cmp": [100, 0]}))
    arrays["cmp_error"] = np.array([1e-6, np.nan])[:, None, None] * np.ones((2, 2, 4))
    assert Endurance.from_arrays(arrays, "cmp").error == pytest.approx([1e-6, np.nan], nan_ok=True)


def _results(cmp_fails_after: float) -> dict[str, Arrays]:
    """CMP fails beyond this light ratio and this share spoilt, dots at the last level."""
    results = {}
    for key, sweep in SWEEPS.items():
        levels = sweep.levels
        lost = [sweep.key == "salt_and_pepper" and level > cmp_fails_after for level in levels]
        lost = [
            a or (key == "light" and b < 1 - cmp_fails_after)
            for a, b in zip(lost, levels, strict=True)
        ]
        for kind in ("cmp", "dmp"):
            counts = [VISIBLE - 1 if at else VISIBLE for at in lost]
            if kind == "dmp":
                counts = [VISIBLE] * (len(levels) - 1) + [0]
            methods = [m.key for m in ALL_METHODS if m.pattern_type == kind]
            results[f"{key}-{kind}"] = _arrays(levels, dict.fromkeys(methods, counts))
    return results


@pytest.mark.parametrize(("fails_after", "met"), [(0.02, False), (0.65, True)])
def test_claims_tell_whether_the_limits_are_met(fails_after: float, met: bool) -> None:
    light, visibility, noise = claims(endurances_of(_results(fails_after)))
    assert (light.met, visibility.met, noise.met) == (met, None, met)


def test_the_first_level_that_fails_is_in_the_table() -> None:
    assert "5 % (never)" in limits(endurances_of(_results(0.02))).rows[0]


def test_the_report_draws_its_figures(tmp_path: Path) -> None:
    made = report(_results(0.02), tmp_path)
    figures = [block.path for block in made.blocks if isinstance(block, Figure)]
    assert len(figures) == 2
    assert all(path.is_file() for path in figures)
