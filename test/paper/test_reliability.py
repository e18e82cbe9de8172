"""Failures are found where they are."""

import numpy as np
import pytest

from paper.experiments.reliability import Endurance
from paper.lab import Arrays

VISIBLE, FRAMES, REPETITIONS = 100, 4, 2


def _arrays(levels: tuple[float, ...], found: dict[str, list[int]]) -> Arrays:
    """Results with these counts of found markers, by method and level, in the worst frame."""
    shape = len(levels), REPETITIONS, FRAMES
    arrays: dict[str, np.ndarray] = {"levels": np.array(levels)}
    for method, counts in found.items():
        all_found = np.full(shape, VISIBLE)
        all_found[:, -1, -1] = counts
        arrays |= {
            f"{method}_found": all_found,
            f"{method}_wrong": np.zeros(shape, int),
            f"{method}_visible": np.full(shape, VISIBLE),
            f"{method}_referenced": np.ones(shape[:2], bool),
        }
    return arrays


def test_one_marker_lost_in_one_frame_is_a_failure() -> None:
    endurance = Endurance.from_arrays(_arrays((0.0, 0.1, 0.2), {"cmp": [100, 99, 100]}), "cmp")
    assert endurance.fails_at == 1
    assert endurance.bears == 0.0
    assert endurance.success == pytest.approx([1, 7 / 8, 1])
    assert endurance.half_lost_at is None


@pytest.mark.parametrize(("what", "value"), [("wrong", 1), ("referenced", False)])
def test_a_wrong_number_or_no_reference_is_a_failure_though_every_marker_is_found(
    what: str, value: float
) -> None:
    arrays = dict(_arrays((0.0, 0.1), {"cmp": [100, 100]}))
    arrays[f"cmp_{what}"][1, 0] = value
    assert Endurance.from_arrays(arrays, "cmp").fails_at == 1
